"""One time step of the material points: against NumPy, and against conservation laws."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support import mpm_oracle as oracle
from support.mpm_oracle import Array

from sim import Body, Effects, Friction, Scene, press
from sim.indenters import sphere
from sim.mpm import Mpm
from sim.mpm.state import IMPULSE_UNIT, ParticleState

SMALL = Body(size_x=1.5e-3, size_y=1e-3, thickness=1e-3)
SCENE = Scene(sphere(1e-3), press([0.2e-3]), SMALL)
EXACT = Mpm(cell=0.5e-3, precision="float64")


def _stirred(scene: Scene, numerics: Mpm) -> tuple[ParticleState, Array]:
    """Return a deformed, moving state and the nodes' velocity (X, Y, Z, 3)."""
    state, lattice, _ = oracle.state_of([scene], numerics)
    random = np.random.default_rng(1)
    count = len(lattice.rest)
    oracle.put(state.batch.shift, random.uniform(-0.3, 0.3, (1, count, 3)))
    oracle.put(state.batch.gradient, random.uniform(-0.1, 0.1, (1, count, 3, 3)))
    velocity = random.uniform(-0.1, 0.1, (*lattice.nodes, 3))
    oracle.put(state.batch.velocity, velocity.reshape(1, -1, 3))
    oracle.put(state.batch.sums, np.zeros(state.batch.sums.shape))
    return state, velocity


@pytest.mark.parametrize(("precision", "error"), [("float64", 1e-11), ("float32", 2e-6)])
def test_a_step_of_the_particles_is_what_numpy_says(precision: str, error: float) -> None:
    state, velocity = _stirred(SCENE, replace(EXACT, precision=precision))
    shear, bulk = float(state.batch.shear.numpy()[0]), float(state.batch.bulk.numpy()[0])
    wanted = oracle.move(
        state.lattice,
        velocity,
        state.batch.shift.numpy()[0],
        state.batch.gradient.numpy()[0],
        shear,
        bulk,
    )
    state.move_particles()
    shift, gradient, sums = wanted
    np.testing.assert_allclose(state.batch.shift.numpy()[0], shift, atol=error)
    np.testing.assert_allclose(state.batch.gradient.numpy()[0], gradient, atol=error)
    np.testing.assert_allclose(oracle.sums_of(state), sums, atol=error)
    assert np.abs(sums[..., 1:]).max() > 0.01


def test_particles_give_the_grid_their_mass_and_momentum_and_not_more() -> None:
    state, _ = _stirred(SCENE, EXACT)
    before = state.batch.shift.numpy()[0].copy()
    state.move_particles()
    velocity = state.batch.shift.numpy()[0] - before
    volume = state.lattice.volume
    sums = oracle.sums_of(state).sum(axis=(0, 1, 2))
    assert sums[0] == pytest.approx(volume.sum(), rel=1e-10)
    np.testing.assert_allclose(sums[1:], volume @ velocity, atol=1e-10)


def test_what_nodes_gain_is_what_indenter_and_base_gave_them() -> None:
    scene = Scene(sphere(1e-3), press([0.2e-3]), SMALL, Effects(friction=Friction(0.4)))
    state, lattice, paces = oracle.state_of([scene], EXACT)
    state.advance(int(paces[0].steps))
    sums = oracle.sums_of(state)
    oracle.put(state.batch.step, np.array([paces[0].steps - 1]))
    state.batch.history.zero_()
    state.begin_step()
    state.step_nodes()
    velocity = state.batch.velocity.numpy()[0].reshape(*lattice.nodes, 3)
    change = (sums[..., :1] * velocity - sums[..., 1:]).sum(axis=(0, 1, 2))
    impulses = state.batch.history.numpy()[0].sum(axis=0) / IMPULSE_UNIT
    np.testing.assert_allclose(change, impulses[:3] + impulses[6:], atol=1e-10)
    assert impulses[2] < -1e-3 < 1e-3 < impulses[8]


def test_the_velocity_field_vanishes_on_the_base() -> None:
    state, lattice, paces = oracle.state_of([SCENE], EXACT)
    state.advance(int(paces[0].steps) - 1)
    velocity = state.batch.velocity.numpy()[0].reshape(*lattice.nodes, 3)
    base = lattice.corner[2]
    spline = np.array([0.125, 0.75, 0.125])
    on_base = np.tensordot(velocity[:, :, base - 1 : base + 2], spline, axes=(2, 0))
    assert np.abs(velocity[:, :, base + 1]).max() > 1e-5
    np.testing.assert_allclose(on_base, 0.0, atol=1e-18)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_what_is_at_rest_stays_at_rest_to_the_last_bit(precision: str) -> None:
    state, _, _ = oracle.state_of([SCENE], replace(EXACT, precision=precision))
    oracle.put(state.batch.corners, np.full((*state.batch.corners.shape, 3), 50.0))
    assert not state.advance(30).any()
    assert not state.batch.shift.numpy().any()
    assert not state.batch.gradient.numpy().any()


def test_a_bonded_column_swings_at_the_speed_of_sound() -> None:
    # With nu = 0 a column's sides do not move: it vibrates in a quarter wave of period 4 T / c.
    body = Body(size_x=2e-3, size_y=2e-3, thickness=8e-3, poisson=0.0)
    scene = Scene(sphere(1e-3), press([0.1e-3]), body)
    state, lattice, paces = oracle.state_of([scene], Mpm(cell=0.5e-3, precision="float64"))
    oracle.put(state.batch.corners, np.full((*state.batch.corners.shape, 3), 50.0))
    oracle.put(state.batch.at, np.array([[0, 0, 10_000]]))
    height = np.arange(lattice.nodes[2]) - lattice.corner[2]
    rising = 1e-5 * np.sin(np.pi / 2 * np.clip(height, -1, 16) / 16)
    velocity = np.zeros((*lattice.nodes, 3))
    velocity[..., 2] = rising
    oracle.put(state.batch.velocity, velocity.reshape(1, -1, 3))
    oracle.put(state.batch.sums, np.zeros(state.batch.sums.shape))
    state.move_particles()
    top = []
    half = 2 * body.thickness / paces[0].wave_speed / paces[0].time_step
    for _ in range(round(1.2 * half)):
        state.advance(1)
        top.append(float(state.surface()[0, 1, 1, 2]))
    # The first of these is the second step: setting the velocity was one.
    time = np.arange(len(top)) + 2
    falling = time > half / 2
    back = np.interp(0.0, -np.array(top)[falling], time[falling])
    assert back == pytest.approx(half, rel=0.01)
    assert max(top) == pytest.approx(1e-5 * 2 * half / math.tau, rel=0.02)
