"""Archives joined by place: presses that match, reasons why others do not, and refusals."""

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.made_up_archives import made_up_archive
from support.planned_archives import (
    MASK,
    planned_archive,
    planned_session,
    raw_folder,
    training_folder,
)
from support.simulated_archives import LAYER, make

from learning.data.genforce.importing import Choices, import_folder
from learning.data.join import join
from learning.data.matching import PlacedPresses, SensorSelection, Tolerances, match
from learning.data.splits import make_split
from learning.errors import LearningError
from learning.markers.build import archive_sessions
from recorder import MarkerArchive, Session, check
from recorder.archive import ArchivePlan, ArchiveWriter, SensorPlan, location_pairs, write_simulated
from recorder.session import press_curves, surface_heights
from sim.dataset import DatasetPlan
from sim.sensors import sensor
from tactile.__main__ import main
from trajectories import PressShear

MM = 1e-3
# The plans of the benches: a GelSight of the homogeneous test, and a TacPalm.
GELSIGHT = PressShear(3 * MM, 4 * MM, 0.3 * MM, 1.2 * MM, math.radians(30), 1 * MM)
TACPALM = PressShear(
    6.5 * MM, 6.5 * MM, 1.125 * MM, 4.5 * MM, math.radians(45), 1.5 * MM, dome_radius=29 * MM
)
# One depth and few directions, for archives made by slower ways.
SMALL = PressShear(3 * MM, 4 * MM, 0.8 * MM, 0.8 * MM, math.radians(90), 1 * MM)


def all_of(*archives: MarkerArchive) -> list[SensorSelection]:
    return [SensorSelection(archive, name, name) for archive in archives for name in archive]


def joined(tmp_path: Path, *archives: MarkerArchive, **options: Any) -> MarkerArchive:
    out = tmp_path / "joined.markers.zarr"
    join(all_of(*archives), **options).write(out)
    assert check(out) == []
    return MarkerArchive(out)


def apart(archive: MarkerArchive, one: str, other: str) -> tuple[Any, Any]:
    """Return how far the pairs of frames of two sensors are apart in place [m], angle [rad].

    Places are those of the ends of the shear, where both have been reached.
    """
    pairs = location_pairs(archive[one].table, archive[other].table)
    tables = archive[one].table, archive[other].table
    angles, places = [], []
    for table, rows in zip(tables, (pairs.source, pairs.target), strict=True):
        position, phase = table["position"][rows], table["phase"][rows]
        places.append(position[phase == 0])
        x, y = (position[phase == 1] - position[phase == 0]).T
        angles.append(np.arctan2(y, x))
    turn = (angles[0] - angles[1] + np.pi) % (2 * np.pi) - np.pi
    return np.linalg.norm(places[0] - places[1], axis=1), np.abs(turn)


@pytest.mark.slow
def test_recordings_in_three_orders_meet_by_place_where_numbers_would_be_off_by_6_to_13_mm(
    tmp_path: Path,
) -> None:
    # A collection run of the paper's authors; a session recorded in the old order, with twice the
    # directions; a simulated archive.
    few = replace(SMALL, angle_step=math.radians(180))
    authors = raw_folder(tmp_path / "uskin-raw", replace(few, clearance=1e-9), indenter="sphere")
    along = Choices(preset_name="uskin", turns_deg={"uskin-raw": 0.0})
    import_folder(authors, tmp_path / "raw.markers.zarr", choices=along)
    old = replace(SMALL, order="quadrants")
    session = planned_session(tmp_path / "s.zarr", old, sensor="pad", indenter="sphere")
    archive_sessions([session], tmp_path / "ours.markers.zarr", preset_name="uskin")
    simulated = replace(sensor("uskin"), trajectory=few, force_depth=None)
    plan = DatasetPlan("targets", (simulated,), indenters=("sphere",), solving=LAYER, steps=1)
    make(tmp_path / "simulated.markers.zarr", plan)
    archives = [MarkerArchive(tmp_path / f"{n}.markers.zarr") for n in ("raw", "ours", "simulated")]
    archive = joined(tmp_path, *archives)
    names = tuple(archive)
    assert names == ("uskin-raw", "pad", "uskin")
    for one, other in ((0, 1), (0, 2), (1, 2)):
        pairs = location_pairs(archive[names[one]].table, archive[names[other]].table)
        assert len(pairs) == 4 * len(few)
        place, angle = apart(archive, names[one], names[other])
        assert len(place) == len(few) == 10
        assert place.max() < 0.1 * MM
        assert math.degrees(angle.max()) < 1
    # By number alone, as before: the same number lies elsewhere for the four outer points.
    same = replace(old, angle_step=few.angle_step)
    off = [
        math.dist(one.origin[:2], other.origin[:2])
        for one, other in zip(few.targets(), same.targets(), strict=True)
        if one.point > 1
    ]
    assert min(off) >= 6 * MM
    assert max(off) <= 13 * MM


def test_of_30_and_45_degrees_only_equal_angles_meet_and_the_rest_is_named(tmp_path: Path) -> None:
    a = planned_archive(tmp_path / "a.markers.zarr", {"gelsight": GELSIGHT})
    b = planned_archive(tmp_path / "b.markers.zarr", {"tacpalm": TACPALM})
    made = join(all_of(a, b))
    (pair,) = made.pairs
    # The centre, at four depths, in the directions 0, 90, 180 and 270 deg.
    assert pair.presses == (240, 160)
    assert pair.matched == 16
    assert pair.frames == 64
    assert pair.place < 1e-6
    assert math.degrees(pair.angle) < 1e-6
    lines = "\n".join(made.lines())
    assert "16 presses matched, of 240 and 160" in lines
    for line in (
        "192 unmatched: gelsight, none of tacpalm at that place, the nearest 4.30 mm away",
        "16 unmatched: tacpalm, none of gelsight there in that direction, the nearest 15.0 deg",
    ):
        assert line in lines
    assert sum(pair.unmatched.values()) == 240 + 160 - 2 * pair.matched


def test_depths_of_a_domed_sensor_are_below_its_surface_in_frames_curves_and_archives(
    tmp_path: Path,
) -> None:
    plan = replace(TACPALM, depth_step=4.5 * MM, angle_step=math.pi)
    path = planned_session(tmp_path / "s.zarr", plan, sensor="palm", indenter="sphere")
    session = Session(path)
    assert surface_heights(session).round(5).tolist() == [0, 0, *[-1.5 * MM] * 8]
    frames = session.frames
    for target in range(len(plan)):
        of_target = frames["depth"][frames["target"] == target]
        assert of_target.max() == pytest.approx(4.5 * MM, abs=1e-6)
        assert of_target[-1] == pytest.approx(-plan.clearance, abs=1e-6)
    assert press_curves(session).depth.max() == pytest.approx(4.5 * MM, abs=1e-6)
    archive_sessions([path], tmp_path / "a.markers.zarr", preset_name="uskin")
    table = MarkerArchive(tmp_path / "a.markers.zarr")["palm"].table
    deepest = [table["depth"][table["target"] == target].max() for target in range(len(plan))]
    assert deepest == pytest.approx([4.5 * MM] * len(plan), abs=1e-6)
    # A session from before the dome says nothing of one, and its depths are as they were.
    flat = planned_session(
        tmp_path / "flat.zarr", replace(plan, dome_radius=None), sensor="palm", indenter="sphere"
    )
    assert not surface_heights(Session(flat)).any()


@pytest.mark.slow
def test_a_joined_archive_holds_all_frames_and_can_be_split(tmp_path: Path) -> None:
    a = planned_archive(tmp_path / "a.markers.zarr", {"a": SMALL}, ("sphere", "own"))
    b = made_up_archive(tmp_path / "b.markers.zarr", indenters=("cone", "sphere"), force_depth=1)
    lone = planned_archive(tmp_path / "c.markers.zarr", {"c": replace(SMALL, order="quadrants")})
    archive = joined(tmp_path, a, b, lone)
    assert set(archive) == {"a", "c", *b}
    assert archive.indenters[-1] == "own"
    for source in (a, b, lone):
        for name in source:
            before, after = source[name], archive[name]
            np.testing.assert_array_equal(after.packed(slice(None)), before.packed(slice(None)))
            np.testing.assert_array_equal(after.references, before.references)
            for column in ("wrench", "position", "depth", "phase", "frame", "valid", "seen"):
                np.testing.assert_array_equal(after.table[column], before.table[column])
            assert [archive.indenters[one] for one in after.table["indenter"]] == [
                source.indenters[one] for one in before.table["indenter"]
            ]
            lines = [[one.sources[line] for line in one.table["source"]] for one in (before, after)]
            assert lines[0] == lines[1]
            unlocated = before.table["location"] < 0
            np.testing.assert_array_equal(after.table["location"] < 0, unlocated)
            if before.fields is not None:
                np.testing.assert_array_equal(
                    after.displacement(slice(None)), before.displacement(slice(None))
                )
    assert archive["grid"].attrs["displacement_of"] == "dots"
    assert archive["c"].attrs["joined_from"]["archive"] == "c.markers.zarr"
    split = make_split(archive, validation=0.2, new_press=0.2, held_out_sensors=(), seed=0)
    split.check(archive)
    assert len(location_pairs(archive["a"].table, archive["c"].table)) == 4 * len(SMALL)


def test_forces_of_twins_are_joined_and_those_of_another_twin_replace_them(tmp_path: Path) -> None:
    a = planned_archive(tmp_path / "a.markers.zarr", {"a": SMALL})
    c = planned_archive(tmp_path / "c.markers.zarr", {"c": replace(SMALL, order="quadrants")})
    out = tmp_path / "joined.markers.zarr"
    for told in ("a twin", "another twin"):
        force = np.random.default_rng(len(told)).normal(size=(len(a["a"]), 3))
        write_simulated(a["a"], force, 0.1 * force, told)
        a = MarkerArchive(a.path)
        join(all_of(a, c)).write(out)
        assert check(out) == []
        archive = MarkerArchive(out)
        found = archive["a"].simulated
        assert found is not None
        np.testing.assert_array_equal(found.force, force)
        np.testing.assert_array_equal(found.spread, 0.1 * force)
        assert found.made_from == told
        assert archive["c"].simulated is None


def test_states_of_one_press_stay_together(tmp_path: Path) -> None:
    archives = []
    for name, places in (("a", [(0, 0), (4, 0)]), ("b", [(4, 0), (0, 0), (-4, 0)])):
        path, rows = tmp_path / f"{name}.markers.zarr", 3 * len(places)
        plan = SensorPlan(name, rows, 3, 3, MASK, 0.03)
        writer = ArchiveWriter.begin(path, ArchivePlan((plan,), ("sphere",)))
        for target, place in enumerate(places):
            table = {
                **dict.fromkeys(("indenter", "t_ns", "reference"), np.zeros(3, int)),
                **dict.fromkeys(("seen", "valid"), np.ones(3, bool)),
                "location": 3 * target + np.arange(3),
                "target": np.full(3, target),
                "phase": np.full(3, -1),
                "depth": np.array([0.5, 1.0, 1.5]) * MM,
                "position": np.tile(np.array(place) * MM, (3, 1)),
                "wrench": np.full((3, 6), np.nan),
                "frame": np.arange(3),
            }
            writer.sensors[name].write(
                target, packed=np.repeat(MASK, 3, axis=0), table=table, source=["made"] * 3
            )
        writer.finish()
        archives.append(MarkerArchive(path))
    archive = joined(tmp_path, *archives)
    assert len(location_pairs(archive["a"].table, archive["b"].table)) == 6
    np.testing.assert_array_equal(archive["a"].table["target"], [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(archive["b"].table["target"], [1, 1, 1, 0, 0, 0, 2, 2, 2])
    make_split(archive, validation=0, new_press=0, held_out_sensors=(), seed=0).check(archive)


def test_unknown_places_are_refused_and_a_plan_makes_them_known(tmp_path: Path) -> None:
    folder = training_folder(tmp_path / "homo", ["Array1"], ["sphere"], len(SMALL))
    import_folder(folder, tmp_path / "homo.markers.zarr")
    ours = planned_archive(tmp_path / "a.markers.zarr", {"a": replace(SMALL, order="quadrants")})
    with pytest.raises(LearningError, match=r"Array1: position is 'unknown: 0'.* model of its own"):
        join(all_of(MarkerArchive(tmp_path / "homo.markers.zarr"), ours))
    bench = tmp_path / "bench.yaml"
    bench.write_text(
        "sensor: mine\ntrajectory: {kind: press_shear, step_x_mm: 3.0, step_y_mm: 4.0, "
        "depth_step_mm: 0.8, depth_max_mm: 0.8, angle_step_deg: 90.0, shear_mm: 1.0}\n"
    )
    out = tmp_path / "planned.markers.zarr"
    # The one door for recordings of other people knows such folders too.
    command = ["import", str(folder), "--out", str(out), "--plan", f"Array1={bench}"]
    assert main(command) == 0
    archive = joined(tmp_path, MarkerArchive(out), ours)
    assert archive["Array1"].attrs["plan"]["order"] == "authors"
    place, angle = apart(archive, "Array1", "a")
    assert len(place) == len(SMALL)
    assert place.max() < 1e-9
    assert angle.max() < 1e-9


def test_a_plan_for_a_sensor_or_a_press_that_is_not_there_is_refused(tmp_path: Path) -> None:
    folder = training_folder(tmp_path / "homo", ["Array1"], ["sphere"], len(SMALL))
    out = tmp_path / "a.markers.zarr"
    with pytest.raises(LearningError, match=r"plan: found one of Array2; .* has Array1"):
        import_folder(folder, out, choices=Choices(plans={"Array2": SMALL}))
    fewer = replace(SMALL, points=(1,))
    with pytest.raises(LearningError, match=r"sphere.5: found press 5; its plan has 4"):
        import_folder(folder, out, choices=Choices(plans={"Array1": fewer}))
    raw = raw_folder(tmp_path / "uskin-raw", fewer, indenter="sphere")
    with pytest.raises(LearningError, match=r"layout raw, which tells places itself"):
        import_folder(raw, out, choices=Choices(plans={"uskin-raw": SMALL}))
    assert not out.exists()


def test_a_place_pressed_twice_is_ambiguous_and_named(tmp_path: Path) -> None:
    a = planned_archive(tmp_path / "a.markers.zarr", {"a": SMALL})
    near = replace(SMALL, step_x=0.02 * MM, step_y=0.02 * MM)
    b = planned_archive(tmp_path / "b.markers.zarr", {"b": near})
    with pytest.raises(
        LearningError,
        match=r"b: which of its presses match those of itself is ambiguous within 0\.1 mm.*"
        r"target 0 of sphere \(\+0\.00, \+0\.00 mm, 0\.800 mm deep, 0\.0 deg\), and target \d+",
    ):
        join(all_of(a, b))
    assert join(all_of(a, b), Tolerances(place=0.01 * MM)).pairs[0].matched == 4


def test_a_chain_of_neighbours_is_ambiguous_not_one_place(tmp_path: Path) -> None:
    some = [
        planned_archive(tmp_path / f"{name}.markers.zarr", {name: SMALL}, moved=moved)
        for name, moved in (("a", 0.0), ("b", 0.06 * MM), ("c", 0.12 * MM))
    ]
    assert join(all_of(some[0], some[1])).pairs[0].matched == len(SMALL)
    with pytest.raises(LearningError, match=r"c: which of its presses match those of a is ambig"):
        join(all_of(*some))


def test_equal_names_and_disagreeing_lists_of_unseen_indenters_are_refused(tmp_path: Path) -> None:
    a = planned_archive(tmp_path / "a.markers.zarr", {"a": SMALL})
    b = planned_archive(tmp_path / "b.markers.zarr", {"a": SMALL}, seen=False)
    with pytest.raises(LearningError, match=r"a: found in .*a\.markers\.zarr and in .*b\.markers"):
        join(all_of(a, b))
    other = [SensorSelection(a, "a", "a"), SensorSelection(b, "a", "b")]
    with pytest.raises(LearningError, match=r"sphere: models may be trained on it by a, not by b"):
        join(other)
    join(other, unseen=("sphere",)).write(tmp_path / "j.markers.zarr")
    assert not MarkerArchive(tmp_path / "j.markers.zarr")["a"].table["seen"].any()


def test_nothing_that_meets_is_refused_with_its_reasons(tmp_path: Path) -> None:
    a = planned_archive(tmp_path / "a.markers.zarr", {"a": SMALL})
    b = planned_archive(tmp_path / "b.markers.zarr", {"b": SMALL}, ("cone",))
    with pytest.raises(
        LearningError, match=r"no press matched(.|\n)*20 unmatched: a, b has no press of"
    ):
        join(all_of(a, b))


def presses_of(plan: PressShear, order: Sequence[int], moved: Sequence[float]) -> PlacedPresses:
    """Return presses without an archive, each off by `moved` in x."""
    targets = [list(plan.targets())[index] for index in order]
    place = np.array([target.origin[:2] for target in targets])
    place[:, 0] += moved
    depth = np.array([target.depth for target in targets])
    names = ["sphere" if index % 2 else "cone" for index in order]
    return PlacedPresses(
        of=SensorSelection(archive=None, sensor="s", name="s"),  # type: ignore[arg-type]
        indenter=np.array(names),
        target=np.arange(len(order)),
        location=np.arange(len(order)),
        place=place,
        depth=depth,
        fraction=depth / plan.depth_max,
        angle=np.array([plan.direction_angle(target.direction) for target in targets]),
        flaw=np.full(len(order), ""),
    )


@settings(max_examples=30)
@given(st.data(), st.integers(2, 4))
def test_presses_meet_as_planned_in_any_order_and_with_errors_below_the_tolerance(
    data: st.DataObject, directions: int
) -> None:
    plan = replace(SMALL, angle_step=2 * math.pi / directions, depth_step=0.4 * MM)
    every = range(len(plan))
    orders = [data.draw(st.permutations(every)) for _ in range(2)]
    kept = orders[1][: data.draw(st.integers(1, len(every)))]
    error = st.lists(st.floats(-0.04 * MM, 0.04 * MM), min_size=len(every), max_size=len(every))
    one, other = (
        presses_of(plan, order, data.draw(error)[: len(order)]) for order in (orders[0], kept)
    )
    left, right = match([one, other], Tolerances())
    at = {number: planned for planned, number in zip(orders[0], left.tolist(), strict=True)}
    assert [at[number] for number in right.tolist()] == list(kept)
    # The order of the archives changes nothing.
    right, left = match([other, one], Tolerances())
    at = {number: planned for planned, number in zip(orders[0], left.tolist(), strict=True)}
    assert [at[number] for number in right.tolist()] == list(kept)


def test_the_command_prints_what_met_and_the_next_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    planned_archive(tmp_path / "a.markers.zarr", {"x": SMALL, "y": SMALL})
    planned_archive(tmp_path / "b.markers.zarr", {"x": replace(SMALL, order="quadrants")})
    out = tmp_path / "j.markers.zarr"
    archives = [f"{tmp_path / 'a.markers.zarr'}:x", f"{tmp_path / 'b.markers.zarr'}:x=z"]
    assert main(["archive", "join", *archives, "--dry-run"]) == 0
    assert not out.exists()
    assert main(["archive", "join", *archives, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "within 0.1 mm, 0.04 of the depth, 3 deg:" in printed
    assert (
        "x and z: 20 presses matched, of 20 and 20; 80 pairs of frames; at most 0.000 mm" in printed
    )
    archive = MarkerArchive(out)
    assert tuple(archive) == ("x", "z")
    assert archive.attrs["matched"][0]["matched"] == 20
    assert json.dumps(archive.attrs["tolerances"])
    # Repeated, it finds nothing left to do.
    assert main(["archive", "join", *archives, "--out", str(out)]) == 0
    assert "0 frames copied" in capsys.readouterr().out
