"""A relaxing layer against Lee and Radok, and around loops."""

import numpy as np
import pytest
from support.closed_forms import hereditary

from benchmarks.independent.linear_layer import LinearLayer, layer_sphere
from sim.indenters import Indenter, flat_punch, sphere
from sim.layer import Layer
from sim.layer.solver import simulate_layer
from sim.result import Result
from sim.scene import Body, Effects, Friction, Motion, Scene, Viscosity, press, through

RATIOS, TIMES = (1.0, 0.5), (0.05, 0.3)
RELAXING = Effects(viscosity=Viscosity(RATIOS, TIMES))


def _simulated(
    indenter: Indenter,
    motion: Motion,
    effects: Effects = RELAXING,
    *,
    grid: int = 48,
    tolerance: float = 2e-3,
) -> Result:
    return simulate_layer(
        Scene(indenter, motion, effects=effects), Layer(grid=grid, tolerance=tolerance)
    )


def test_a_punch_held_down_relaxes_as_lee_and_radok_say() -> None:
    motion = press([0.5e-3], hold=0.6, steps=4, speed=0.5e-3 / 0.1)
    found = _simulated(flat_punch(3e-3), motion, tolerance=1e-7)
    elastic = _simulated(flat_punch(3e-3), motion, Effects(), tolerance=1e-7)
    expected = hereditary(motion.time, elastic.force[:, 2], RATIOS, TIMES)
    np.testing.assert_allclose(found.force[:, 2], expected, rtol=1e-6)
    # The load on the skin relaxes, its shape remains.
    np.testing.assert_allclose(found.surface[4], found.surface[-1], atol=1e-9)


@pytest.mark.slow
def test_a_sphere_loads_a_relaxing_layer_as_lee_and_radok_say() -> None:
    depth, ramp = 1e-3, 0.1
    motion = press([depth], hold=0.4, steps=3, speed=depth / ramp)
    found = _simulated(sphere(4e-3), motion, grid=128)
    body = Body()
    depths = np.linspace(0, depth, 22)[1:]
    exact = [
        layer_sphere(d, 4e-3, LinearLayer(body.thickness, body.modulus, body.poisson)).force
        for d in depths
    ]
    times = np.concatenate([np.linspace(0, ramp, 22), motion.time[4:]])
    elastic = np.concatenate([[0.0], exact, np.repeat(exact[-1], 3)])
    expected = hereditary(times, elastic, RATIOS, TIMES)[[0, 7, 14, 21, 22, 23, 24]]
    np.testing.assert_allclose(-found.force[:, 2], expected, rtol=2e-3)


def test_a_press_that_begins_inside_arrived_at_once() -> None:
    inside = Motion(tip=((0, 0, -1e-3),), time=(0.0,))
    relaxing, elastic = (
        _simulated(sphere(4e-3), inside),
        _simulated(sphere(4e-3), inside, Effects()),
    )
    np.testing.assert_allclose(relaxing.force, elastic.force * (1 + sum(RATIOS)), rtol=3e-3)


@pytest.mark.parametrize(("speed", "factor"), [(1e3, 1 + sum(RATIOS)), (1e-7, 1.0)])
def test_very_fast_is_stiff_and_very_slow_is_at_rest(speed: float, factor: float) -> None:
    relaxing = _simulated(sphere(4e-3), press([1e-3], speed=speed))
    elastic = _simulated(sphere(4e-3), press([1e-3]), Effects())
    np.testing.assert_allclose(relaxing.force[-1], elastic.force[-1] * factor, rtol=3e-3, atol=1e-4)


def test_branches_without_stiffness_change_nothing() -> None:
    nothing = Effects(viscosity=Viscosity((0.0,), (0.1,)))
    relaxing = _simulated(sphere(4e-3), press([0.5e-3, 1e-3]), nothing)
    elastic = _simulated(sphere(4e-3), press([0.5e-3, 1e-3]), Effects())
    np.testing.assert_array_equal(relaxing.traction, elastic.traction)


def _down_and_up(steps: int) -> Result:
    depths = np.concatenate([np.arange(steps + 1), np.arange(steps - 1, -1, -1)]) / steps * 1e-3
    motion = through([(0.0, 0.0, -float(depth)) for depth in depths], speed=10e-3)
    return _simulated(sphere(4e-3), motion, grid=64)


def test_loading_lies_above_unloading_and_the_loop_loses_energy() -> None:
    result = _down_and_up(8)
    force = -result.force[:, 2]
    assert (force[1:8] > 1.15 * force[15:8:-1]).all()
    assert (result.traction[..., 2] <= 0).all()
    assert force[-1] == 0
    assert result.quality.energy_gap[-1] > 0.2
    # The skin is still recovering.
    assert result.surface[-1, ..., 2].min() < -50e-6
    fine = _down_and_up(32)
    np.testing.assert_allclose(force, -fine.force[::4, 2], atol=0.01 * force.max())


def test_shear_that_sticks_relaxes_by_its_own_history() -> None:
    corners = [(0, 0, 0), (0, 0, -0.5e-3), (0.1e-3, 0, -0.5e-3)]
    ramp = through(corners, speed=10e-3)
    held = tuple(ramp.time[-1] + wait for wait in (0.05, 0.2, 0.8))
    motion = Motion(tip=ramp.tip + (corners[-1],) * 3, time=ramp.time + held)
    rough = Friction(10.0)
    found = _simulated(
        flat_punch(3e-3),
        motion,
        Effects(friction=rough, viscosity=Viscosity(RATIOS, TIMES)),
        tolerance=1e-5,
    )
    elastic = _simulated(flat_punch(3e-3), motion, Effects(friction=rough), tolerance=1e-5)
    for axis in (0, 2):
        expected = hereditary(motion.time, elastic.force[:, axis], RATIOS, TIMES)
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found.force[:, axis], expected, atol=0.005 * scale)


def test_friction_and_relaxation_together_end_without_force_and_give_nothing_away() -> None:
    corners = [(0, 0, 0), (0, 0, -1e-3), (0.5e-3, 0, -1e-3), (0, 0, -1e-3), (0, 0, 1e-3)]
    effects = Effects(friction=Friction(0.5), viscosity=Viscosity(RATIOS, TIMES))
    result = _simulated(sphere(4e-3), through(corners, speed=10e-3), effects)
    assert result.quality.slip_excess.max() < 1e-6
    assert result.quality.energy_gap.min() > -0.01
    assert result.quality.energy_gap[-1] > 0.3
    np.testing.assert_array_equal(result.force[-1], 0)
