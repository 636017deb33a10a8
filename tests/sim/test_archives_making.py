"""Content of archives: references, rows of a unit, forces, presses without a solution."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.copies import digests
from support.simulated_archives import COARSE, LAYER, LIVED, SKINS, make, own_grid, solved_once

from recorder import MarkerArchive, SessionError, check
from recorder.archive import ArchivedSensor, location_pairs
from sim import Fem, Layer, Result, Scene, SceneError, SimulationDiverged, press, simulate
from sim.dataset import DatasetPlan, Solving, begin, gel, reopened
from sim.dataset import plan as solving
from sim.dataset.generate import sensor_reader
from sim.dataset.plan import families
from sim.dataset.summary import summary
from sim.errors import PassesThrough
from sim.indenters import named
from sim.scene import through
from sim.sensors import SurfaceField, sensor

# The archive that most tests read takes 12 s of one core, and a minute on a busy machine.

__all__ = ["own_grid", "solved_once"]


@pytest.fixture(scope="module")
def skins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("archives") / "skins.markers.zarr"
    make(path, SKINS)
    return path


def press_rows(each: ArchivedSensor, indenter: str, target: int) -> np.ndarray[Any, Any]:
    code = each.table["indenter"]
    names = MarkerArchive(each.path.parent).indenters
    return np.flatnonzero((code == names.index(indenter)) & (each.table["target"] == target))


@pytest.mark.slow
def test_an_archive_is_sound_and_its_plan_is_in_it(skins: Path) -> None:
    assert list(check(skins)) == []
    assert reopened(skins).plan == SKINS
    assert reopened(skins).missing() == ()
    archive = MarkerArchive(skins)
    assert list(archive) == ["r6", "r18", "uskin"]
    assert archive["r6"].attrs["pattern"] == "Array-I"
    assert archive["r6"].mm_per_px == pytest.approx(0.0249)
    assert archive["uskin"].fields is None
    made = json.loads(archive["r6"].sources[0])
    assert made["small strain"] is True
    assert (made["tier"], made["indenter"], made["target"]) == ("layer", "sphere", 0)


def test_frames_before_contact_are_their_reference_without_force_or_displacement(
    skins: Path,
) -> None:
    for name in ("r6", "r18"):
        each = MarkerArchive(skins)[name]
        still = np.flatnonzero(each.table["frame"] == 0)
        assert len(still) == 2 + 3
        for row in still:
            if each.table["target"][row] < 48:
                np.testing.assert_array_equal(each.masks([row])[0], each.reference(row))
                assert not each.table["wrench"][row].any()
                assert not np.nan_to_num(each.displacement([row])).any()
    pad = MarkerArchive(skins)["uskin"]
    first = int(press_rows(pad, "sphere", 0)[0])
    # Noise of 2 counts moves a disc by a twentieth of a pixel.
    assert np.count_nonzero(pad.masks([first])[0] ^ pad.reference(first)) < 200


def test_a_skin_of_twice_the_modulus_takes_twice_the_force_of_a_solution_of_its_own(
    skins: Path,
) -> None:
    archive = MarkerArchive(skins)
    press = families(SKINS)[0].presses[0]
    for name in ("r6", "r18"):
        rows = press_rows(archive[name], press.indenter, press.recordings[0].target)
        own = simulate(sensor(name).placed(named("sphere"), press.motion, seed=0), COARSE)
        scale = np.abs(own.wrench[:, :3]).max()
        assert scale > 0.1
        np.testing.assert_allclose(
            archive[name].table["wrench"][rows][:, :3], own.wrench[:, :3], atol=2e-3 * scale
        )


def test_sensors_that_share_a_location_were_pressed_alike(skins: Path) -> None:
    one, other = MarkerArchive(skins)["r6"], MarkerArchive(skins)["r18"]
    pairs = location_pairs(one.table, other.table)
    assert len(pairs) == 2 * 1 * 4
    for column in ("depth", "position", "phase"):
        np.testing.assert_array_equal(
            one.table[column][pairs.source], other.table[column][pairs.target]
        )


def test_force_and_depth_come_three_times_down_and_up_under_the_prism(skins: Path) -> None:
    each = MarkerArchive(skins)["r6"]
    targets = np.unique(each.table["target"][each.table["location"] < 0])
    assert targets.tolist() == [48, 49, 50]
    for target in targets:
        rows = press_rows(each, "prism", target)
        depth, force = each.table["depth"][rows], -each.table["wrench"][rows, 2]
        assert depth.max() == pytest.approx(1.4e-3)
        loading = each.table["phase"][rows] == 0
        assert (np.diff(depth[loading]) >= 0).all()
        assert (np.diff(depth[~loading]) <= 0).all()
        half = np.abs(depth - 0.55e-3) < 1e-9
        # Relaxation has reduced the force on the way.
        assert force[half & loading].item() > force[half & ~loading].item() > 0


def test_a_part_of_the_indenters_sensors_and_patterns_has_the_rows_of_the_whole(
    skins: Path, tmp_path: Path
) -> None:
    part = replace(SKINS, indenters=("cone",), sensors=(sensor("r18"),))
    make(tmp_path / "part.markers.zarr", part)
    few, whole = MarkerArchive(tmp_path / "part.markers.zarr")["r18"], MarkerArchive(skins)["r18"]
    for indenter, target in (("cone", 0), ("prism", 49)):
        mine, theirs = (press_rows(each, indenter, target) for each in (few, whole))
        assert len(mine) == len(theirs) == 5
        np.testing.assert_array_equal(few.packed(mine), whole.packed(theirs))
        np.testing.assert_array_equal(few.displacement(mine), whole.displacement(theirs))
        for column in few.table:
            if column != "source":
                np.testing.assert_array_equal(few.table[column][mine], whole.table[column][theirs])


@pytest.mark.slow
def test_patterns_of_one_gel_share_its_field(tmp_path: Path) -> None:
    plan = DatasetPlan(
        "states", (gel(("Array4", "Diamond4")),), indenters=("sphere",), solving=LAYER
    )
    make(tmp_path / "two.markers.zarr", plan)
    archive = MarkerArchive(tmp_path / "two.markers.zarr")
    assert list(check(tmp_path / "two.markers.zarr")) == []
    one, other = archive["Array4"], archive["Diamond4"]
    assert len(one) == len(other) == 45
    np.testing.assert_array_equal(one.displacement([44]), other.displacement([44]))
    assert not (other.path / "displacement").exists()
    assert len(location_pairs(one.table, other.table)) == 45
    np.testing.assert_allclose(one.table["position"][40], [4e-3, 4e-3])
    np.testing.assert_allclose(one.table["depth"][40:], 1e-3 * np.array([0.3, 0.6, 0.9, 1.2, 1.5]))


@pytest.mark.slow
@pytest.mark.usefixtures("own_grid")
def test_a_sensor_in_use_has_a_reference_for_every_contact_point(tmp_path: Path) -> None:
    make(tmp_path / "lived.markers.zarr", LIVED)
    each = MarkerArchive(tmp_path / "lived.markers.zarr")["array-i"]
    assert each.references.shape == (18, 38400)
    assert np.count_nonzero(each.masks([0])[0] ^ each.reference(0)) < 2500
    rows = press_rows(each, "cone", int(each.table["target"].min()))
    assert set(each.table["reference"][rows]) == {3}
    # Device variation tilts and shifts them: no two sensors would share this deformation.
    assert np.abs(each.table["wrench"][rows][:, 3:5]).max() > 0


def test_a_skin_that_crept_lies_elsewhere_under_an_indenter_that_stays() -> None:
    body = sensor("array-i").body
    x = np.linspace(-body.size_x / 2, body.size_x / 2, 81)
    bell = np.exp(-(x[:, None] ** 2 + x**2) / (3e-3) ** 2)
    dent = np.stack([0 * bell, 0 * bell, -1e-3 * bell], axis=-1)[None].astype(np.float32)
    offset = np.array([0.25e-3, -0.5e-3])
    top = SurfaceField(x, x, dent).crept(offset)
    places = np.array([[1e-3, 0.5e-3], [-2e-3, 1e-3]])
    found_ = top.at(places)[0]
    here = np.exp(-((places + offset) ** 2).sum(axis=1) / (3e-3) ** 2)
    np.testing.assert_allclose(found_[:, :2], np.tile(offset, (2, 1)), atol=1e-8)
    np.testing.assert_allclose(found_[:, 2], -1e-3 * here, rtol=1e-3)


def diverging(times: int) -> Any:
    """Return `simulate_many` in which each call's first press finds no solution `times` times."""
    real = solving.simulate_many
    left = [times]

    def simulate_many(scenes: Sequence[Scene], *_: Any, **_options: Any) -> list[Any]:
        outcomes: list[Result | SimulationDiverged] = list(real(scenes, COARSE))
        if left[0] > 0:
            left[0] -= 1
            outcomes[0] = SimulationDiverged("no converged state; state: /tmp/x/state.npz")
        return outcomes

    return simulate_many


ONE = replace(
    SKINS, sensors=(sensor("r6"),), indenters=("sphere", "cone"), solving=Solving(spacing=2e-3)
)


@pytest.mark.slow
def test_a_press_without_a_solution_is_marked_with_its_reasons_and_in_no_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solving, "simulate_many", diverging(2))
    path = tmp_path / "lost.markers.zarr"
    make(path, ONE)
    each = MarkerArchive(path)["r6"]
    lost = press_rows(each, "sphere", 0)
    assert not each.table["valid"][lost].any()
    assert each.table["valid"].sum() == len(each) - len(lost)
    assert not each.masks(lost).any()
    assert np.isnan(each.table["wrench"][lost]).all()
    assert np.isnan(each.displacement(lost)).all()
    made = json.loads(each.sources[each.table["source"][lost[0]]])
    assert made["failed"] == [
        "as asked for: no converged state",
        "steps of 1/100 of the thickness, float64: no converged state",
    ]
    assert len(location_pairs(each.table, each.table)) == 4
    assert list(check(path)) == []
    message = "\n".join(summary(path))
    assert (
        "1 presses have no solution, their rows are not valid\n  sphere, target 0 of r6:" in message
    )
    # One that another way solves says which.
    monkeypatch.setattr(solving, "simulate_many", diverging(1))
    path = tmp_path / "again.markers.zarr"
    make(path, ONE)
    each = MarkerArchive(path)["r6"]
    assert each.table["valid"].all()
    made = json.loads(each.sources[0])
    assert made["again"] == "steps of 1/100 of the thickness, float64"
    message = "\n".join(summary(path, check=False))
    assert "1 presses were solved again in another way\n  sphere, target 0 of r6: solved" in message


@pytest.mark.parametrize(
    ("kind", "way"),
    [
        (SimulationDiverged, "steps of 1/100 of the thickness, float64"),
        (PassesThrough, "elements 0.6 times as large"),
    ],
)
def test_presses_without_a_solution_are_solved_again_together_by_what_may_help(
    kind: type[SimulationDiverged], way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = []

    def simulate_many(scenes: Sequence[Scene], tier: Fem, **_how: Any) -> list[Any]:
        calls.append((len(scenes), tier))
        first = len(calls) == 1
        return [kind("no state") if first and i % 2 else result for i in range(len(scenes))]

    scene = Scene(named("sphere"), press([0.2e-3]))
    result = simulate(scene, Layer())
    monkeypatch.setattr(solving, "simulate_many", simulate_many)
    solved = solving.solve([scene] * 5, Solving(spacing=2e-3))
    assert [count for count, _ in calls if count] == [5, 2]
    assert [one.how.get("again") for one in solved] == [None, way, None, way, None]
    assert solved[1].how["failed"] == ["as asked for: no state"]
    (finer,) = [tier for count, tier in calls if count == 2]
    assert (finer.spacing < 2e-3) == (kind is PassesThrough)


def test_another_plan_is_refused_by_its_keys_and_what_is_no_archive_by_its_name(
    skins: Path, tmp_path: Path
) -> None:
    before = digests(skins)
    with pytest.raises(SceneError, match=r"differs in seed, steps; allowed: the same options"):
        begin(skins, replace(SKINS, seed=9, steps=2))
    assert digests(skins) == before
    (tmp_path / "empty").mkdir()
    with pytest.raises(SessionError, match="empty"):
        begin(tmp_path / "empty", SKINS)
    with pytest.raises(SessionError, match=r"nothing\.zarr"):
        reopened(tmp_path / "nothing.zarr")


@pytest.mark.slow
def test_a_tolerance_is_kept_and_said() -> None:
    down = through([(0, 0, 0), (0, 0, -5e-4)], speed=1e-2)
    scene = sensor("gelsight").scene(named("sphere"), down)
    (solved,) = solving.solve([scene], Solving(tolerance="60 %"))
    assert solved.result is not None
    assert solved.how["tolerance"] == "60 %"


def test_the_pixels_of_taxels_are_as_large_as_their_pitch_says() -> None:
    each = sensor_reader(sensor("uskin"), 0, "cpu", 18)
    assert each.readout.mm_per_px == pytest.approx(4.7 / 128)
