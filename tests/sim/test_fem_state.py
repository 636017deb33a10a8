import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array

from sim import Body, Effects, Friction, Inertia, Scene, press
from sim.fem import Fem
from sim.fem.assembly import Assembly
from sim.fem.mesh import build_mesh
from sim.indenters import sphere

BODY = Body(size_x=4e-3, size_y=5e-3, thickness=3e-3, poisson=0.4)
FIRST = np.array([True, False])
BOTH = np.array([True, True])
TIP = np.array([[0.0, 0.0, -0.1], [0.1, 0.0, -0.15]])
STEP = np.array([2e-3, 5e-3])


def _assembly() -> Assembly:
    effects = Effects(friction=Friction(0.4), inertia=Inertia())
    scene = Scene(sphere(2e-3), press([1e-4]), BODY, effects)
    return Assembly([build_mesh(BODY, 1e-3)] * 2, [scene] * 2, Fem(), "float64", "cpu")


def _pressure(assembly: Assembly) -> Array:
    state = assembly.state
    assembly.evaluate(state.everyone, state.u, wp.zeros_like(assembly.residual))
    return np.asarray(state.contact.pressure.numpy().copy())


def _pressed() -> Assembly:
    """Return an assembly with both indenters pressed into undeformed bodies."""
    assembly = _assembly()
    assembly.state.begin_step(BOTH, TIP, STEP, np.zeros(2))
    assembly.state.set_tip(BOTH)
    return assembly


def test_pressure_that_is_carried_is_there_without_penetration_until_it_is_given_up() -> None:
    """With the same penetration in addition, the pressure doubles, only in the selected one."""
    assembly = _pressed()
    state = assembly.state
    once = _pressure(assembly)
    assert (once.max(axis=(1, 2)) > 0).all()
    state.update_multiplier(oracle.integers(FIRST))
    twice = _pressure(assembly)
    np.testing.assert_allclose(twice[0][once[0] > 0], 2 * once[0][once[0] > 0], rtol=1e-12)
    np.testing.assert_array_equal(twice[1], once[1])
    state.rollback_step(state.everyone)
    np.testing.assert_array_equal(_pressure(assembly), once)


def test_giving_up_returns_to_the_pressure_of_the_step_before() -> None:
    assembly = _pressed()
    state = assembly.state
    once = _pressure(assembly)
    assembly.accept(FIRST, STEP)
    np.testing.assert_array_equal(state.contact.multiplier.numpy()[0], once[0])
    assert not state.contact.multiplier.numpy()[1].any()
    _pressure(assembly)
    state.update_multiplier(state.everyone)
    assert not np.array_equal(state.contact.multiplier.numpy()[0], once[0])
    state.rollback_step(state.everyone)
    np.testing.assert_array_equal(state.contact.multiplier.numpy()[0], once[0])
    assert not state.contact.multiplier.numpy()[1].any()


def test_tips_go_where_their_step_ends_and_back_to_where_it_began() -> None:
    state = _assembly().state
    start = np.array([[0.0, 0.0, 0.1], [0.0, 0.1, 0.2]])
    state.start(start)
    np.testing.assert_array_equal(state.contact.tip.numpy(), start)
    state.begin_step(FIRST, TIP, STEP, np.zeros(2))
    np.testing.assert_array_equal(state.contact.tip.numpy(), start)
    state.set_tip(BOTH)
    np.testing.assert_array_equal(state.contact.tip.numpy(), [TIP[0], start[1]])
    np.testing.assert_array_equal(state.travel(BOTH).numpy(), [TIP[0] - start[0], [0, 0, 0]])
    np.testing.assert_array_equal(state.travel(~FIRST).numpy(), np.zeros((2, 3)))
    state.set_tip(FIRST, before=True)
    np.testing.assert_array_equal(state.contact.tip.numpy(), start)


def test_an_accepted_step_is_where_the_next_begins_for_the_chosen_only() -> None:
    assembly = _pressed()
    state = assembly.state
    _pressure(assembly)
    state.u.assign(np.ones((*state.u.shape, 3)))
    assembly.accept(FIRST, STEP)
    np.testing.assert_array_equal(state.contact.u_old.numpy()[:, 0, 0], [1.0, 0.0])
    np.testing.assert_array_equal(state.tip_before, [TIP[0], [0, 0, 0]])
    np.testing.assert_array_equal(state.travel(BOTH).numpy(), [[0, 0, 0], TIP[1]])


@pytest.mark.parametrize("chosen", [BOTH, FIRST])
def test_a_step_begins_by_extrapolation_and_bodies_fly_on_at_their_speed(chosen: Array) -> None:
    """u starts with a fraction of the last change; without forces it flies on.

    Its first step is backward Euler's, of which the second knows the velocity only; u' and u'' of
    the second are by parabolas through the last three displacements and velocities.
    """
    assembly = _pressed()
    state = assembly.state
    before, now = states = np.random.default_rng(1).normal(0, 0.01, (2, *state.u.shape, 3))
    for times, u in enumerate(states, 1):
        state.begin_step(BOTH, times * TIP, STEP, np.zeros(2))
        state.u.assign(u)
        assembly.accept(BOTH, STEP)
    state.predicted.zero_()
    guess, step = np.array([0.5, 1.5]), np.array([3e-3, 1e-3])
    state.begin_step(chosen, 2 * TIP + TIP * (step / STEP)[:, None], step, guess)
    which = chosen[:, None, None]
    expected = np.where(which, now + guess[:, None, None] * (now - before), now)
    np.testing.assert_allclose(state.u.numpy(), expected, atol=1e-15)
    first, second, third = (  # weights of the values before, the last ones, and the next ones
        np.array([np.polyder(np.polyfit(t, one, 2)) @ [t[2], 1] for t in times])[:, None, None]
        for one in np.eye(3)
        for times in [[(-a, 0.0, b) for a, b in zip(STEP, step, strict=True)]]
    )
    velocities = [before / STEP[:, None, None]]
    one, two = 0.5 / STEP[:, None, None], 1.5 / STEP[:, None, None]
    velocities += [two * now - (one + two) * before]
    still = -(first * before + second * now) / third
    flown = still - (first * velocities[0] + second * velocities[1]) / third**2
    np.testing.assert_allclose(state.predicted.numpy(), np.where(which, flown, 0.0), atol=1e-15)
    mass = BODY.density * BODY.thickness**2 / BODY.modulus
    rate = mass * third.ravel() ** 2
    assert state.inertia_rate.numpy()[chosen] == pytest.approx(rate[chosen])
