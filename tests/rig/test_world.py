"""The mock bench's physics: known values, limits, and effects that are absent when off."""

import contextlib
import dataclasses
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rig.bench.bench import BenchFile, find_bench
from rig.bench.worlds import AnalyticSpec, Hysteresis, Layer, MarkerView, Punch, Sphere, TaxelField
from rig.core.packaged import BENCHES
from rig.mock.world.analytic import AnalyticWorld
from rig.mock.world.picture import MarkerCamera, PressedSurface
from rig.mock.world.truth import Truth, TruthLog

LAYER = Layer(modulus=145e3, thickness=4e-3, poisson=0.45)
BARE = AnalyticSpec(layer=LAYER, indenter=Punch(radius=3e-3), gauge_depth=0.02)
FRAME = (-0.12, -0.43, 0.16, 0.0, 0.0, 0.0)
MS = 1_000_000


def states_along(spec: AnalyticSpec, places: np.ndarray, step_ns: int = 2 * MS) -> np.ndarray:
    """Return WORLD_STATE (n,) along tip positions (n, 3) in the contact frame [m]."""
    world = AnalyticWorld(spec, FRAME)
    origin = np.array(FRAME[:3])
    return np.array(
        [
            world.step(k * step_ns, np.array([*(origin + place), math.pi, 0, 0]))
            for k, place in enumerate(places)
        ]
    )


def press(depth: float, n: int = 100) -> np.ndarray:
    """Return positions (2 n, 3) straight down to `depth` and back up."""
    z = -depth * np.concatenate([np.linspace(0, 1, n), np.linspace(1, 0, n)])
    return np.stack([0 * z, 0 * z, z], axis=1)


@pytest.mark.parametrize(
    ("ratio", "poisson", "kappa"), [(0.4, 0.30, 1.4726), (1.0, 0.45, 3.0914), (2.0, 0.50, 9.1494)]
)
def test_the_punch_has_hayes_values(ratio: float, poisson: float, kappa: float) -> None:
    layer = Layer(modulus=1e5, thickness=4e-3, poisson=poisson)
    radius, depth = ratio * layer.thickness, 1e-4
    expected = 2 * layer.modulus * radius * depth * kappa / (1 - poisson**2)
    assert Punch(radius).force(layer, depth) == pytest.approx(expected, rel=1e-9)


def test_a_thick_layer_is_a_half_space_and_one_outside_the_formulas_is_refused() -> None:
    thick = Layer(modulus=1e5, thickness=10.0, poisson=0.5)
    punch = Punch(3e-3).force(thick, 1e-3)
    assert punch == pytest.approx(2 * 1e5 * 3e-3 * 1e-3 / 0.75, rel=2e-3)
    hertz = 4 / 3 * 1e5 / 0.75 * math.sqrt(4e-3) * 1e-3**1.5
    assert Sphere(4e-3).force(thick, 1e-3) == pytest.approx(hertz, rel=1e-3)
    for poisson in (0.2, 0.51):
        with pytest.raises(ValueError, match="poisson"):
            dataclasses.replace(thick, poisson=poisson)


def test_the_sphere_lies_within_its_stated_error_of_the_exact_solution() -> None:
    # Exact axisymmetric solution, R = 4 mm, h = 4 mm, nu = 0.45, E = 0.145 MPa.
    for depth, exact, error in ((0.1e-3, 0.01833, 0.01), (0.5e-3, 0.26300, 0.04)):
        assert Sphere(4e-3).force(LAYER, depth) == pytest.approx(exact, rel=error)


@given(st.floats(1e-6, 2e-3), st.floats(1.01, 2))
def test_force_grows_with_depth_and_modulus(depth: float, factor: float) -> None:
    stiffer = dataclasses.replace(LAYER, modulus=factor * LAYER.modulus)
    for indenter in (Punch(3e-3), Sphere(4e-3)):
        force = indenter.force(LAYER, depth)
        assert indenter.force(LAYER, factor * depth) > force > 0
        assert indenter.force(stiffer, depth) == pytest.approx(factor * force)


def test_compression_is_negative_and_nothing_is_felt_above_the_surface() -> None:
    states = states_along(BARE, np.array([[0, 0, 1e-3], [0, 0, 0], [0, 0, -1e-3], [0, 0, 1e-4]]))
    assert (states["wrench"][[0, 1, 3]] == 0).all()
    assert states["wrench"][2, 2] == pytest.approx(-Punch(3e-3).force(LAYER, 1e-3))
    assert states["depth"] == pytest.approx([-1e-3, 0, 1e-3, -1e-4], abs=1e-15)


def test_without_friction_and_hysteresis_force_is_a_function_of_depth_alone() -> None:
    states = states_along(BARE, press(1e-3))
    down, up = states[:100], states[100:][::-1]
    np.testing.assert_allclose(down["wrench"], up["wrench"], atol=1e-12)
    sideways = states_along(BARE, np.array([[0, 0, -1e-3], [1e-3, 0, -1e-3]]))
    assert (sideways["wrench"][:, :2] == 0).all()
    assert (sideways["shear"] == 0).all()


def test_a_dome_is_touched_at_its_own_height_and_pressed_as_deep() -> None:
    domed = dataclasses.replace(BARE, dome_radius=29e-3)
    drop = 29e-3 - math.sqrt(29e-3**2 - 2 * 6.5e-3**2)
    assert drop == pytest.approx(1.5e-3, abs=1e-5)
    tip = np.array([[0, 0, -1e-3], [6.5e-3, -6.5e-3, -1e-3], [6.5e-3, -6.5e-3, -1e-3 - drop]])
    states = states_along(domed, tip)
    assert states["depth"] == pytest.approx([1e-3, 1e-3 - drop, 1e-3])
    forces = states["wrench"][:, 2]
    assert forces[0] == pytest.approx(forces[2])
    assert forces[1] == 0
    lever = [6.5e-3, -6.5e-3, BARE.gauge_depth - drop]
    np.testing.assert_allclose(
        states["wrench"][2, 3:], np.cross(lever, states["wrench"][2, :3]), atol=1e-12
    )


@given(st.floats(0.05, 2), st.floats(0, 2 * math.pi))
def test_friction_drags_along_the_motion_and_never_beyond_coulomb(mu: float, angle: float) -> None:
    spec = dataclasses.replace(BARE, friction=mu)
    steps = np.linspace(0, 2e-3, 50)
    places = np.stack(
        [steps * math.cos(angle), steps * math.sin(angle), np.full(50, -1e-3)], axis=1
    )
    wrench = states_along(spec, places)["wrench"]
    drag = np.hypot(wrench[:, 0], wrench[:, 1])
    assert (drag <= mu * -wrench[:, 2] * (1 + 1e-9)).all()
    assert (np.diff(drag) >= -1e-12).all()
    along = wrench[1:, 0] * math.cos(angle) + wrench[1:, 1] * math.sin(angle)
    np.testing.assert_allclose(along, drag[1:], rtol=1e-9)


def test_sticking_gives_the_drag_of_a_disc_with_its_torque_and_coming_back_gives_it_back() -> None:
    spec = dataclasses.replace(BARE, friction=10.0)
    places = np.array([[2e-3, 1e-3, -1e-3], [2.1e-3, 1e-3, -1e-3], [2e-3, 1e-3, -1e-3]])
    force, torque = np.split(states_along(spec, places)["wrench"], 2, axis=1)
    assert force[1, 0] == pytest.approx(LAYER.disc_shear_stiffness(3e-3) * 1e-4)
    assert force[2, 0] == pytest.approx(0, abs=1e-12)
    lever = places * (1, 1, 0) + (0, 0, BARE.gauge_depth)
    np.testing.assert_allclose(torque, np.cross(lever, force), atol=1e-12)


def hysteretic(fraction: float) -> AnalyticSpec:
    return dataclasses.replace(BARE, hysteresis=Hysteresis(fraction=fraction, relaxation=0.1))


def test_hysteresis_lifts_loading_above_unloading_and_relaxes_to_the_elastic_force() -> None:
    states = states_along(hysteretic(0.2), press(1e-3))
    down, up = states[1:100], states[100:-1][::-1]
    assert (-down["wrench"][:, 2] >= -up["wrench"][:, 2]).all()
    held = np.repeat(press(1e-3)[:100], [1] * 99 + [1000], axis=0)
    end = states_along(hysteretic(0.2), held)["wrench"][-1, 2]
    assert end == pytest.approx(-Punch(3e-3).force(LAYER, 1e-3), rel=1e-6)
    assert (states["wrench"][:, 2] <= 0).all()


def test_hysteresis_tends_to_none_as_its_fraction_does_and_does_not_depend_on_the_step() -> None:
    faint, none = (states_along(spec, press(1e-3)) for spec in (hysteretic(1e-9), BARE))
    np.testing.assert_allclose(faint["wrench"], none["wrench"], atol=1e-7)
    coarse = states_along(hysteretic(0.2), press(1e-3, 51)[:51], step_ns=8 * MS)
    fine = states_along(hysteretic(0.2), press(1e-3, 401)[:401], step_ns=1 * MS)
    # Exact for a force that is linear in time, as for a punch.
    np.testing.assert_allclose(fine["wrench"][::8], coarse["wrench"], atol=1e-9)


def surface(depth: float = 1e-3, shear: tuple[float, float] = (0.0, 0.0)) -> PressedSurface:
    # The tip has moved to where it dragged the surface.
    return PressedSurface(centre=shear, depth=depth, radius=3e-3, thickness=4e-3, shear=shear)


VIEW = MarkerView("grid", pitch=1.6e-3, radius=0.26e-3, pixel=0.0249e-3)


def test_markers_move_outwards_sideways_with_shear_and_rest_without_contact() -> None:
    camera = MarkerCamera(VIEW)
    rest = camera.pixels(surface(depth=0.0))
    pressed = camera.pixels(surface()) - rest
    away = rest - np.array([319.5, 239.5])
    assert ((pressed * away).sum(axis=1) >= -1e-9).all()
    assert np.hypot(*pressed.T).max() > 2
    dragged = camera.pixels(surface(shear=(5e-4, 0.0))) - camera.pixels(surface())
    middle = np.hypot(*away.T).argmin()
    assert dragged[middle] == pytest.approx([5e-4 / VIEW.pixel, 0], abs=0.01)


def test_image_markers_are_where_the_pixels_say_and_six_rings_of_a_hexagon_have_127() -> None:
    camera = MarkerCamera(VIEW)
    state = surface(shear=(2e-4, -1e-4))
    grey = cv2.cvtColor(camera.image(state), cv2.COLOR_RGB2GRAY)
    _, _, _, centres = cv2.connectedComponentsWithStats((grey < 70).astype(np.uint8))
    expected = camera.pixels(state)
    assert len(dataclasses.replace(VIEW, layout="hexagon", rings=6).points()) == 127
    inside = expected[(expected > 12).all(axis=1) & (expected < [628, 468]).all(axis=1)]
    distance = np.linalg.norm(centres[1:, None] - inside[None], axis=2).min(axis=0)
    assert len(inside) > 40
    assert distance.max() < 0.3


def test_image_noise_is_absent_unless_asked_for_and_has_its_size() -> None:
    quiet = MarkerCamera(VIEW)
    assert (quiet.image(surface()) == quiet.image(surface())).all()
    noisy = MarkerCamera(VIEW, grey_noise=2.0)
    difference = noisy.image(surface()).astype(int) - quiet.image(surface())
    assert difference.std() == pytest.approx(2.0, rel=0.05)


def test_taxels_rest_apart_and_count_up_when_pressed() -> None:
    pad = TaxelField()

    def counts(**state: object) -> np.ndarray:
        return pad.counts(surface(**state).displacement(pad.positions()))

    rest, pressed = counts(depth=0.0), counts()
    assert rest.shape == (16, 3)
    inner = [5, 6, 9, 10]
    assert (pressed[inner, 2] - rest[inner, 2] > 1000).all()
    right = counts(shear=(5e-4, 0)) - pressed
    assert (right[inner, 0] > 100).all()
    up = counts(shear=(0, 5e-4)) - pressed
    assert (up[inner, 1] > 100).all()
    signs = np.sign(pad.positions()[[0, 3, 12]]).tolist()
    assert signs == [[-1, -1], [1, -1], [-1, 1]]


def test_the_truth_log_gives_back_what_was_logged_between_and_despite_a_torn_end(
    tmp_path: Path,
) -> None:
    states = states_along(BARE, press(1e-3))
    path = tmp_path / "truth"
    with contextlib.closing(TruthLog(path)) as log:
        for state in states:
            log.append(state)
    with path.open("ab") as file:
        file.write(b"torn")
    truth = Truth(path)
    assert len(truth.records) == len(states)
    times = np.array([0, 3 * MS, 10 * MS])
    expected = np.interp(times, states["t_ns"], states["wrench"][:, 2])
    np.testing.assert_allclose(truth.wrench(times)[:, 2], expected, atol=1e-12)
    np.testing.assert_allclose(
        truth.depth(times), np.interp(times, states["t_ns"], states["depth"])
    )


def test_full_depth_forces_stand_4_to_2_to_1() -> None:
    force = {}
    for sensor in ("uskin", "gelsight-hetero", "tacpalm"):
        bench = BenchFile.read(find_bench(sensor, BENCHES)).bench
        assert bench.world is not None
        depth = bench.trajectory.depth_max
        force[sensor] = bench.world.indenter.force(bench.world.layer, depth)
    assert force["uskin"] / force["gelsight-hetero"] == pytest.approx(2, rel=0.05)
    assert force["gelsight-hetero"] / force["tacpalm"] == pytest.approx(2, rel=0.1)
