"""Public interface of the layer tier: errors, results and reports."""

import json

import numpy as np

from sim.indenters import named, sphere
from sim.layer import Layer
from sim.layer.solver import simulate_layer
from sim.scene import Body, Effects, Friction, Scene, press, through


def test_a_result_has_a_frame_for_each_waypoint_and_says_what_ran() -> None:
    motion = press([0.8e-3], shear=0.4e-3, steps=2)
    body = Body(size_x=24e-3, size_y=16e-3)
    scene = Scene(named("prism"), motion, body=body, effects=Effects(friction=Friction(0.6)))
    told: list[float] = []
    result = simulate_layer(scene, Layer(grid=48), progress=told.append)
    assert result.tier == "layer"
    assert result.surface.shape == result.traction.shape == (9, 48, 32, 3)
    assert result.surface_x.shape == (48,)
    assert result.surface_y.shape == (32,)
    assert told == [(frame + 1) / 9 for frame in range(9)]
    assert result.record["effects"] == ["friction"]
    assert set(result.record["seconds"]) == {"build", "contact", "frames"}
    json.dumps(result.record)
    again = simulate_layer(scene, Layer(grid=48))
    np.testing.assert_array_equal(result.traction, again.traction)
    np.testing.assert_array_equal(result.surface, again.surface)
    quality = result.quality
    assert (quality.residual <= 2e-3).all()
    assert (quality.newton[1:-1] >= 1).all()
    assert (quality.steps >= 1).all()
    assert (quality.cg == 0).all()
    assert np.isnan(quality.balance).all()
    assert np.isnan(quality.det_f_min).all()


def test_force_and_torque_are_those_of_the_tractions() -> None:
    motion = through([(1e-3, 0, 0), (1e-3, 0, -1e-3), (1.2e-3, 0.3e-3, -1e-3)], speed=1e-2)
    scene = Scene(named("triangle"), motion, effects=Effects(friction=Friction(0.6)))
    result = simulate_layer(scene, Layer(grid=64))
    area = (result.surface_x[1] - result.surface_x[0]) * (result.surface_y[1] - result.surface_y[0])
    push = result.traction[-1].astype(float) * area
    np.testing.assert_allclose(result.wrench[-1, :3], push.sum(axis=(0, 1)), rtol=1e-5)
    place = result.surface[-1].astype(float)
    place[..., 0] += result.surface_x[:, None]
    place[..., 1] += result.surface_y[None, :]
    torque = np.cross(place - motion.tip[-1], push).sum(axis=(0, 1))
    assert np.abs(torque).max() > 1e-5
    np.testing.assert_allclose(result.wrench[-1, 3:], torque, atol=1e-9)


def test_above_the_body_nothing_happens_and_contact_is_found_on_the_way() -> None:
    scene = Scene(sphere(4e-3), through([(0, 0, 5e-3), (0, 0, 1e-3), (0, 0, -1e-3)], speed=0.1))
    result = simulate_layer(scene, Layer(grid=64))
    np.testing.assert_array_equal(result.wrench[:2], 0)
    np.testing.assert_array_equal(result.surface[:2], 0)
    straight = simulate_layer(Scene(sphere(4e-3), press([1e-3])), Layer(grid=64))
    np.testing.assert_allclose(result.force[-1], straight.force[-1], atol=1e-3)
    # Moving through the air is one step, not one per half pixel.
    assert result.quality.steps[-1] < 20


def test_the_usual_tolerance_and_precision_agree_with_the_tightest() -> None:
    scene = Scene(
        named("cone"),
        press([0.9e-3], shear=0.4e-3, steps=2),
        effects=Effects(friction=Friction(0.6)),
    )
    usual, tight = (
        simulate_layer(scene, Layer(grid=64)),
        simulate_layer(scene, Layer(grid=64, tolerance=1e-7)),
    )
    assert usual.record["precision"] == "float32"
    assert tight.record["precision"] == "float64"
    scale = np.abs(tight.force).max()
    np.testing.assert_allclose(usual.force, tight.force, atol=1e-3 * scale)
    np.testing.assert_allclose(usual.surface, tight.surface, atol=2e-3 * 0.9e-3)


def test_a_flat_tip_just_touching_bears_nothing() -> None:
    motion = through([(0, 0, 0), (0, 0, -0.5e-3), (0, 0, 0)], speed=1e-2)
    effects = Effects(friction=Friction(0.6))
    result = simulate_layer(Scene(named("cylinder"), motion, effects=effects), Layer(grid=48))
    assert result.force[1, 2] < -0.5
    np.testing.assert_array_equal(result.force[[0, 2]], 0)
