"""Forces extrapolated to zero element size: the law, its gain for a press, and its errors."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sim import (
    Body,
    Effects,
    Extrapolated,
    Friction,
    Layer,
    Measured,
    Mpm,
    Scene,
    SceneError,
    SimulationDiverged,
    indenters,
    press,
    simulate,
)
from sim.extrapolation import extrapolated, simulate_extrapolated
from sim.fem.numerics import FOR_EDGES, Fem
from sim.indenters import named
from sim.result import Result
from tactile.__main__ import main

BODY = Body(8e-3, 8e-3, 4e-3)
SPHERE = Scene(named("sphere"), press([0.6e-3]), BODY, Effects(friction=Friction(0.8)))


@pytest.fixture(scope="module")
def coarse() -> Result:
    return simulate(SPHERE, Fem(spacing=4e-3 / 3, grading=FOR_EDGES))


def on(result: Result, cells: int, wrench: Any) -> Result:
    """Return a result as if computed with this number of elements over the depth."""
    mesh = {**result.record["mesh"], "cells": [1, 1, cells]}
    return replace(result, wrench=np.array(wrench), record={**result.record, "mesh": mesh})


@pytest.mark.parametrize(("few", "many"), [(3, 4), (3, 5), (6, 10)])
def test_an_error_that_falls_as_the_square_is_taken_off_whole(
    coarse: Result, few: int, many: int
) -> None:
    exact = np.array([[0.0] * 6, [0.1, -0.2, -2.0, 1e-3, 2e-3, 0.0]])
    found = extrapolated(
        on(coarse, few, exact * (1 + 0.9 / few**2)), on(coarse, many, exact * (1 + 0.9 / many**2))
    )
    np.testing.assert_allclose(found.wrench, exact, rtol=1e-12)
    fraction = (0.9 / many**2) / (1 + 0.9 / many**2)
    assert found.record["extrapolated"]["cells"] == [few, many]
    assert found.record["extrapolated"]["force_share"] == pytest.approx(fraction)


@pytest.mark.slow
def test_both_meshes_are_solved_and_the_finer_ones_skin_is_kept(coarse: Result) -> None:
    numerics = Fem(spacing=1e-3, grading=FOR_EDGES)
    single = simulate(SPHERE, numerics)
    reported: list[float] = []
    both = simulate_extrapolated([SPHERE], numerics, progress=reported.append)[0]
    assert isinstance(both, Result)
    assert both.record["extrapolated"]["cells"] == [3, 4]
    np.testing.assert_array_equal(both.surface, single.surface)
    assert both.force[-1, 2] > single.force[-1, 2] > coarse.force[-1, 2]
    assert reported == sorted(reported)
    assert reported[-1] == 1


@pytest.mark.slow
def test_two_coarse_meshes_meet_the_converged_force_of_a_sphere() -> None:
    # Forces on which two element families agree to 0.1 % (docs/results/refinement.md).
    exact = np.array([0.2652, 0.9197, 1.9560])
    scene = Scene(indenters.sphere(4e-3), press([0.5e-3, 1e-3, 1.5e-3]), Body())
    numerics = Fem(spacing=0.8e-3, grading=FOR_EDGES)
    single, both = (
        -simulate(scene, tier).force[-3:, 2] for tier in (numerics, Extrapolated(numerics))
    )
    assert (single / exact - 1 > 0.008).all()
    assert (abs(both / exact - 1) < 0.003).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere", "torus", "prism", "dots"])
def test_two_coarse_meshes_come_closer_than_the_better_of_them(name: str) -> None:
    scene = Scene(
        named(name), press([0.8e-3]), Body(10e-3, 10e-3, 4e-3), Effects(friction=Friction(0.8))
    )
    fine, single = (
        simulate(scene, Fem(spacing=spacing, grading=FOR_EDGES)).force[-1, 2]
        for spacing in (0.4e-3, 0.8e-3)
    )
    both = simulate(scene, Extrapolated(Fem(spacing=0.8e-3, grading=FOR_EDGES))).force[-1, 2]
    # By the same law, a quarter of the error at 0.8 mm remains at 0.4 mm.
    exact = fine - (single - fine) / 3
    assert abs(both - exact) < 0.35 * abs(single - exact)
    assert abs(both - exact) < 0.01 * abs(exact)


def test_a_press_without_a_solution_on_either_mesh_has_none(
    coarse: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost = SimulationDiverged("nothing found")
    outcomes = iter([[lost, on(coarse, 3, coarse.wrench)], [on(coarse, 4, coarse.wrench), lost]])
    monkeypatch.setattr("sim.extrapolation.simulate_many", lambda *a, **k: next(outcomes))
    assert simulate_extrapolated([SPHERE, SPHERE]) == [lost, lost]


@pytest.mark.parametrize(
    ("scenes", "fem", "reported"),
    [
        ([SPHERE], Fem(), r"fem.grading.finer: 1; allowed where forces are extrapolated"),
        (
            [SPHERE],
            Fem(spacing=4e-3 / 3, grading=FOR_EDGES),
            r"fem.spacing: 1.33 mm; allowed .*: 1 mm or less in 4 mm",
        ),
        (
            [SPHERE, replace(SPHERE, body=Body(8e-3, 8e-3, 3e-3))],
            Fem(grading=FOR_EDGES),
            r"scenes: bodies of 2 thicknesses; allowed .*: one",
        ),
    ],
)
def test_what_has_no_second_mesh_is_refused(scenes: list[Scene], fem: Fem, reported: str) -> None:
    with pytest.raises(SceneError, match=reported):
        simulate_extrapolated(scenes, fem)


@pytest.mark.parametrize("tier", [Layer(), Mpm(), Measured()])
def test_only_elements_are_extrapolated(tier: Any) -> None:
    with pytest.raises(SceneError, match=r"extrapolated\.fem: .*; allowed: a Fem"):
        Extrapolated(tier)


def test_meshes_that_are_alike_tell_nothing(coarse: Result) -> None:
    with pytest.raises(SceneError, match="3 and 3 elements over the depth; allowed: fewer, then"):
        extrapolated(coarse, coarse)


def test_a_press_of_the_command_line_tells_what_was_added(
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = ["sim", "press", "--depths", "0.4", "--size", "8,8,4", "--mesh", "1", "--extrapolate"]
    assert main([*asked, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["extrapolated"]["cells"] == [3, 4]
    assert any("extrapolated from 3 and 4 elements" in note for note in told["notes"])
