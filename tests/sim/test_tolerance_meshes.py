"""Solver accuracy and meshes required by a tolerance."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim import Body, Effects, Scene, press
from sim.errors import SimulationDiverged
from sim.fem import Fem, solver
from sim.fem.sizing import Sizes, Span
from sim.fem.solver import Required, simulate_fem
from sim.indenters import sphere
from sim.result import Outcome, Result
from sim.scene import Viscosity
from sim.tiers import simulate
from sim.tolerance import STATES_MOST, _states, simulate_within

BALL = Scene(sphere(4e-3), press([0.3e-3]))
WET = replace(BALL, effects=Effects(viscosity=Viscosity((0.5,), (0.1,))))


@pytest.mark.parametrize(
    ("scene", "fraction", "tolerance", "path"),
    [
        (BALL, 0.02, 2e-4, 2e-3),
        (BALL, 0.5, STATES_MOST, 10 * STATES_MOST),
        (BALL, 1e-4, 1e-4, 1e-3),
        (WET, 0.02, 2e-4, None),
    ],
    ids=["two per cent", "coarse", "finest", "history"],
)
def test_states_are_as_exact_as_a_tolerance_asks(
    scene: Scene, fraction: float, tolerance: float, path: float | None
) -> None:
    states = _states(scene, fraction)
    assert states.tolerance == pytest.approx(tolerance)
    assert states.path_tolerance == (None if path is None else pytest.approx(path))


@pytest.mark.slow
def test_what_a_solution_asks_for_spares_the_next_mesh_being_made_anew() -> None:
    key = 0, len(BALL.motion)
    far_too_coarse = Span(-3e-3, 3e-3, 1.5e-3)
    required: Required = {key: Sizes((far_too_coarse,), (far_too_coarse,), 1.5e-3, 2e-3)}
    numerics = Fem(fineness=0.5, tolerance=1e-3)
    (first,) = simulate_fem([BALL], numerics, required=required)
    assert isinstance(first, Result)
    assert first.record["mesh"]["made_anew"] >= 1
    assert required[key].x != (far_too_coarse,)
    (second,) = simulate_fem([BALL], numerics, required=required)
    assert isinstance(second, Result)
    assert "made_anew" not in second.record["mesh"]
    np.testing.assert_allclose(second.force, first.force, rtol=0.02, atol=1e-4)


@pytest.mark.slow
def test_states_of_a_contact_far_smaller_than_the_thickness_are_balanced() -> None:
    """The force is 2 mN, a thirtieth of the least force that the thickness alone would suggest."""
    scene = Scene(sphere(0.5e-3), press([0.05e-3]), Body(80e-3, 80e-3, 20e-3))
    loose, exact = (
        simulate(scene, Fem(fineness=0.3, tolerance=one, path_tolerance=one)).force
        for one in (1e-2, 1e-5)
    )
    np.testing.assert_allclose(loose[-1, 2], exact[-1, 2], rtol=0.01)


@pytest.mark.slow
def test_a_light_touch_is_balanced_well_enough_for_a_tolerance() -> None:
    body = Body(34e-3, 34e-3, 4e-3)
    scene = Scene(sphere(20e-3), press([0.02e-3]), body)
    forces = []
    for tolerance in (_states(scene, 0.01).tolerance, _states(scene, 0.03).tolerance, 1e-5):
        (found,) = simulate_fem([scene], Fem(fineness=0.95, tolerance=tolerance))
        assert isinstance(found, Result)
        forces.append(found.force[-1, 2])
    np.testing.assert_allclose(forces[:2], forces[2], rtol=2e-3)


def test_where_a_coarse_mesh_finds_no_solution_finer_ones_are_tried_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Meshes are half as fine as they say, to save time; those below a fineness fail."""
    dump = tmp_path / "diverged" / "state.npz"
    solved: list[float] = []
    fails_below = 0.5

    def simulate(scenes: list[Scene], numerics: Fem, **how: Any) -> list[Outcome]:
        solved.append(round(numerics.fineness, 3))
        if numerics.fineness < fails_below:
            dump.parent.mkdir()
            dump.touch()
            return [SimulationDiverged(f"lost; state: {dump}", tried=(), dump=dump)]
        coarser = replace(numerics, fineness=numerics.fineness / 2)
        (found,) = simulate_fem(scenes, coarser, **{**how, "required": None})
        assert isinstance(found, Result)
        mesh = {**found.record["mesh"], "fineness": numerics.fineness}
        return [replace(found, record={**found.record, "mesh": mesh})]

    monkeypatch.setattr(solver, "simulate_fem", simulate)
    found = simulate_within(BALL, "30 %", tier="fem")
    assert solved == [0.375, 0.6, 0.96]
    assert found.record["plan"]["tried"][0] == "fineness 0.6: lost"
    assert not dump.parent.exists()
    fails_below = 2.0
    with pytest.raises(SimulationDiverged, match="lost"):
        simulate_within(BALL, "30 %", tier="fem")
    assert solved[3:] == [0.375, 0.6]
