"""Forces and errors measured by two meshes, for a tolerance."""

from dataclasses import replace

import numpy as np
import pytest

from sim import plan, simulate, tolerance
from sim.error_estimate import waves_share
from sim.fem import Fem
from sim.indenters import sphere
from sim.metrics import tolerance_of
from sim.result import Result
from sim.scene import Body, Motion, Scene, press

BALL = Scene(sphere(4e-3), press([0.3e-3, 0.6e-3]), Body(12e-3, 12e-3))
FINE = Fem(spacing=0.4e-3)


@pytest.fixture(scope="module")
def truth() -> Result:
    """Press with elements of 0.4 mm, the remaining error of its force extrapolated from 0.8 mm."""
    fine, coarse = (simulate(BALL, one) for one in (FINE, Fem(spacing=0.8e-3)))
    whole = replace(fine.quality, contact=np.zeros(3))
    return replace(fine, wrench=fine.wrench + (fine.wrench - coarse.wrench) / 3, quality=whole)


@pytest.mark.parametrize("ratio", [4 / 3, 5 / 3])
def test_an_error_that_falls_as_the_square_is_taken_off_whole(truth: Result, ratio: float) -> None:
    exact = truth.wrench
    mesh = truth.record["mesh"]
    coarse = replace(
        truth,
        wrench=exact * (1 + 0.02 * ratio**2),
        record={**truth.record, "mesh": {**mesh, "cells": [n / ratio for n in mesh["cells"]]}},
    )
    fine = replace(truth, wrench=exact * 1.02)
    both, error = tolerance.extrapolated(coarse, fine, tolerance_of("5 %"), floor=1e-3)
    np.testing.assert_allclose(both.wrench, exact, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(both.surface, fine.surface)
    assert error == pytest.approx(0.02, rel=1e-6)
    assert both.record["error"]["second_mesh"] == coarse.record["mesh"]


def test_meshes_that_agree_by_chance_state_what_a_coarser_one_shows(truth: Result) -> None:
    mesh = truth.record["mesh"]

    def found(ratio: float, off: float) -> Result:
        record = {**truth.record, "mesh": {**mesh, "cells": [n / ratio for n in mesh["cells"]]}}
        return replace(truth, wrench=truth.wrench * (1 + off), record=record)

    meshes = found(1.5, 0.0), found(1.0, 0.0), tolerance_of("5 %"), 1e-3
    assert tolerance.extrapolated(*meshes)[1] == 1e-3
    least = 0.1 / (2**3 - 1) * (1 - 1.5**-3) / (1.5**2 - 1)
    assert tolerance.extrapolated(*meshes, found(3.0, 0.1))[1] == pytest.approx(least)


def test_forces_by_damped_waves_are_within_the_error_that_two_meshes_tell(truth: Result) -> None:
    """Stress that is damped over a time adds this time by its rate to a force, of order 1."""
    ratio, added = 1.6, 0.05
    motion = press([0.3e-3, 0.6e-3], speed=1.0)
    truth = replace(truth, scene=replace(truth.scene, motion=motion))

    def mesh(length: float) -> Result:
        mesh = truth.record["mesh"]
        cells = [n / length for n in mesh["cells"]]
        damped = {**mesh, "cells": cells, "damped": 1e-4 * length}
        record = {**truth.record, "mesh": damped}
        return replace(truth, wrench=truth.wrench * (1 + added * length), record=record)

    both, error = tolerance.extrapolated(mesh(ratio), mesh(1.0), tolerance_of("5 %"), floor=1e-3)
    left = float((both.force[1:, 2] / truth.force[1:, 2] - 1).max())
    assert left < error < 2 * left
    assert error < 0.5 * waves_share(mesh(1.0)).max()
    for height, felt in (0.4e-3, True), (0.9e-3, False):  # a tip that has left for a moment
        tip = *motion.tip[:2], (0.0, 0.0, height)
        lifted = replace(mesh(1.0), scene=replace(truth.scene, motion=Motion(tip, motion.time)))
        lifted.wrench[-1] = 0.0
        assert bool(waves_share(lifted)[-1]) == felt


def test_a_tolerance_is_kept(truth: Result) -> None:
    result = plan(BALL, "2 %").run()
    assert result.record["error"]["percent"] <= 2
    np.testing.assert_allclose(result.force[:, 2], truth.force[:, 2], rtol=0.02)


@pytest.mark.slow
def test_one_that_the_meshes_allowed_do_not_reach_has_its_own_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(tolerance.ELEMENTS_MAX, "cpu", 26_000)
    record = plan(BALL, "0.11 %").run().record
    assert not record["plan"]["reached"]
    assert 0.11 < record["error"]["percent"] < 2
    assert record["plan"]["notes"][0].startswith("0.11 % was not reached: ")


@pytest.mark.slow
def test_the_limit_on_elements_leaves_a_coarser_mesh_to_measure_by(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(tolerance.ELEMENTS_MAX, "cpu", 1000)
    scene = Scene(sphere(4e-3), press([0.3e-3]))
    error = plan(scene, "8 %", only="fem").run().record["error"]
    assert error["second_mesh"]["elements"] < 0.6 * 1000
    assert not plan(scene, "3 %", only="fem").run().record["plan"]["reached"]


def test_meshes_too_much_alike_tell_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(tolerance.ELEMENTS_MAX, "cpu", 1000)
    monkeypatch.setattr(tolerance, "RATIO_LEAST", 9.0)
    result = plan(BALL, "0.3 %").run()
    assert result.record["error"]["status"] == "estimated"
    assert not result.record["plan"]["reached"]
    assert "no coarser mesh to measure by" in " ".join(result.record["plan"]["tried"])
