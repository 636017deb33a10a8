"""Marker archives: parallel writing in any order, local and remote reading, checks and pairing."""

import json
import multiprocessing
import os
import pickle
import random
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import zarr
from fsspec.asyn import get_loop
from support.copies import digests
from support.crashes import FailingCalls, Killed
from support.sessions import edit_json, flip

from recorder import MarkerArchive, Session, SessionError, check
from recorder.archive import (
    COLUMNS,
    ArchivePlan,
    ArchiveWriter,
    SensorPlan,
    location_pairs,
    marker_flags,
    press_rows,
)
from recorder.markers import HEIGHT, WIDTH, Lattice, pack
from recorder.spec import PHASES
from tactile.__main__ import main
from tests.support.few import few
from tests.support.zarr_readers import READERS, reader_of_zarr

get_loop()  # fsspec keeps one thread for the life of the process

LATTICE = Lattice(step_px=80, margin_px=80)
INDENTERS = ("sphere", "cone")
ROWS, CHUNK, UNIT = 23, 2, 6


def mask_of(row: int) -> np.ndarray[Any, Any]:
    """Return 13 x 10 squares that move with the row."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return ((x - 20 - row % 5) % 50 < 20) & ((y - 20 - row % 3) % 50 < 20)


REFERENCES = pack(np.stack([mask_of(0), mask_of(1)]))
PACKED = pack(np.stack([mask_of(row) for row in range(ROWS)]))


def plan(name: str = "Array1", **changes: Any) -> SensorPlan:
    made = SensorPlan(
        name, ROWS, CHUNK, UNIT, REFERENCES, 0.0339, LATTICE, attrs={"pattern": {"pitch": 1.5}}
    )
    return replace(made, **changes)


PLAN = ArchivePlan((plan(), plan("Circle1", lattice=None)), INDENTERS, {"made_from": "a test"})


def unit_of(rows: slice, sensor: str = "Array1") -> dict[str, Any]:
    """Return the data of a unit of the plan; the row number is encoded in every row."""
    row = np.arange(rows.start, rows.stop)
    wrench = np.repeat(row[:, None] * -0.1, 6, axis=1)
    wrench[row % 7 == 3] = np.nan
    table = {
        "indenter": row // 12,
        "seen": row % 2 == 0,
        "location": row // 4,
        "target": row // 4 % 3,
        "phase": row % 4,
        "depth": row * 1e-4,
        "position": np.stack([row * 1e-3, row * -1e-3], axis=1),
        "wrench": wrench,
        "frame": row % 4,
        "t_ns": row * 25_000_000,
        "reference": row % 2,
        "valid": row != 15,
    }
    unit = {
        "packed": PACKED[row],
        "table": table,
        "source": [f'{{"press": {number // 4}, "depth": "0,5 \u00b5m"}}' for number in row],
    }
    if sensor == "Array1":
        field = row[:, None, None, None] * np.ones(LATTICE.shape) / 8
        field[:, 0, 0] = np.nan
        unit["displacement"] = field.astype(np.float16)
    return unit


def write_units(writer: ArchiveWriter, name: str, units: Sequence[int]) -> None:
    sensor = writer.sensors[name]
    for unit in units:
        sensor.write(unit, **unit_of(sensor.rows_of(unit), name))


def make_archive(path: Path, made_from: ArchivePlan = PLAN) -> Path:
    """Write the missing units of an archive, as `tactile sim archive states` does."""
    writer = ArchiveWriter.begin(path, made_from)
    for name, units in writer.missing().items():
        write_units(writer, name, units)
    writer.finish()
    return path


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_archive(tmp_path_factory.mktemp("archive") / "a.markers.zarr")


@pytest.fixture
def copy(archive: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(archive, tmp_path / "copy.markers.zarr"))


# ------------------------------------------------------------------------------------ reading


def test_what_was_written_is_read(archive: Path) -> None:
    opened = MarkerArchive(archive)
    assert (opened.status, opened.warning, opened.indenters) == ("complete", None, INDENTERS)
    assert (list(opened), opened.attrs["made_from"]) == (["Array1", "Circle1"], "a test")
    sensor = opened["Array1"]
    assert (len(sensor), sensor.mm_per_px) == (ROWS, 0.0339)
    assert sensor.attrs["pattern"] == {"pitch": 1.5}
    np.testing.assert_array_equal(sensor.packed(slice(None)), PACKED)
    for name, values in unit_of(slice(0, ROWS))["table"].items():
        found = sensor.table[name]
        assert (found.dtype, found.shape[1:]) == (COLUMNS[name].dtype, COLUMNS[name].shape)
        np.testing.assert_array_equal(found, values)
    lines = [sensor.sources[row] for row in sensor.table["source"]]
    assert lines == unit_of(slice(0, ROWS))["source"]
    assert len(sensor.sources) == 6


def test_rows_come_in_the_order_asked_for(archive: Path) -> None:
    sensor = MarkerArchive(archive)["Array1"]
    rows = [22, 0, 7, 7, 13]
    np.testing.assert_array_equal(sensor.masks(rows), np.stack([mask_of(row) for row in rows]))
    field = sensor.displacement(np.array(rows))
    assert (field.dtype, field.shape) == (np.float16, (5, *LATTICE.shape))
    np.testing.assert_array_equal(field[:, 1, 1, 0], np.array(rows) / 8)
    assert np.isnan(field[:, 0, 0]).all()
    assert sensor.lattice == LATTICE
    np.testing.assert_array_equal(sensor.reference(5), mask_of(1))
    assert sensor.masks([]).shape == (0, HEIGHT, WIDTH)


@pytest.mark.parametrize("rows", [[-1], [ROWS], [0.5], [[1]]])
def test_rows_that_are_not_there_are_errors(archive: Path, rows: Any) -> None:
    with pytest.raises(SessionError, match=r"no row|expected integers"):
        MarkerArchive(archive)["Array1"].packed(rows)


def test_what_an_archive_lacks_is_named(archive: Path) -> None:
    opened = MarkerArchive(archive)
    with pytest.raises(SessionError, match="Circle1: keeps no displacement"):
        opened["Circle1"].displacement([0])
    with pytest.raises(KeyError, match="no sensor 'Array2'; known: Array1, Circle1"):
        opened["Array2"]
    with pytest.raises(KeyError, match="no column 'force'"):
        opened["Array1"].table["force"]
    with pytest.raises(SessionError, match="no row 23"):
        opened["Array1"].reference(23)


def every_array(path: Path) -> Iterator[tuple[Path, np.ndarray[Any, Any]]]:
    """Yield each array of the archive with its content."""
    for name, sensor in MarkerArchive(path).items():
        yield path / name / "markers", sensor.packed(slice(None))
        yield path / name / "references", sensor.references
        for column, values in sensor.table.items():
            yield path / name / "table" / column, values
    yield path / "Array1" / "displacement", MarkerArchive(path)["Array1"].displacement(slice(None))


def test_zarr_reads_every_array_with_units_and_dimension_names(archive: Path) -> None:
    for path, values in every_array(archive):
        array = zarr.open_array(path, mode="r")
        np.testing.assert_array_equal(array[:], values)
        assert array.attrs["units"]
        assert array.attrs["description"]
        assert len(array.metadata.dimension_names or ()) == values.ndim
    table = zarr.open_group(archive, mode="r")["Array1/table"]
    assert table["indenter"].attrs["names"] == list(INDENTERS)  # type: ignore[index]
    assert table["phase"].attrs["names"] == list(PHASES)  # type: ignore[index]
    text = np.asarray(zarr.open_array(archive / "Array1/sources", mode="r"))
    assert text[1].tobytes().rstrip(b"\0").decode() == MarkerArchive(archive)["Array1"].sources[1]


@pytest.mark.parametrize("reader", READERS)
def test_other_readers_of_zarr_read_every_array(reader: str, archive: Path) -> None:
    read = reader_of_zarr(reader)
    for path, values in every_array(archive):
        np.testing.assert_array_equal(np.asarray(read(path), values.dtype), values)


def test_an_archive_behind_a_url_reads_alike(archive: Path) -> None:
    fsspec.filesystem("memory").put(str(archive), "/bucket/a.markers.zarr", recursive=True)
    remote, local = MarkerArchive("memory://bucket/a.markers.zarr"), MarkerArchive(archive)
    np.testing.assert_array_equal(remote["Array1"].packed([20, 3]), local["Array1"].packed([20, 3]))
    np.testing.assert_array_equal(
        remote["Array1"].displacement([4]), local["Array1"].displacement([4])
    )
    assert remote["Circle1"].sources == local["Circle1"].sources
    assert check("memory://bucket/a.markers.zarr") == []
    again = pickle.loads(pickle.dumps(remote))  # as passed to the workers of a data loader
    np.testing.assert_array_equal(again["Array1"].packed([5]), PACKED[[5]])
    np.testing.assert_array_equal(again["Array1"].table["frame"], local["Array1"].table["frame"])


def test_a_newer_archive_and_what_is_none_are_refused(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="found format 'tactile-rig markers'"):
        Session(copy)
    set_attributes(copy, format_version=2)
    with pytest.raises(SessionError, match="format_version 2, this program reads 1; update it"):
        MarkerArchive(copy)
    set_attributes(copy, format="tactile-rig session")
    with pytest.raises(SessionError, match="expected 'tactile-rig markers'"):
        MarkerArchive(copy)
    with pytest.raises(SessionError, match="no such archive"):
        MarkerArchive(tmp_path / "nowhere")


def set_attributes(group: Path, **attrs: Any) -> None:
    edit_json(group / "zarr.json", lambda document: document["attributes"].update(attrs))


@pytest.mark.parametrize("name", ["Array1/markers/c.1.0", "Array1/displacement/c.1.0.0.0"])
def test_a_missing_shard_is_an_error_and_no_fill_values(copy: Path, name: str) -> None:
    (copy / name).unlink()
    sensor = MarkerArchive(copy)["Array1"]
    read = sensor.packed if "markers" in name else sensor.displacement
    read([0, 5])
    with pytest.raises(SessionError, match=r"c\.1\.0.*shard missing"):
        read([0, 6])


@pytest.mark.parametrize("harm", ["a byte of a chunk", "a byte of the index", "cut short"])
def test_a_changed_byte_and_a_file_cut_short_are_errors(copy: Path, harm: str) -> None:
    shard = copy / "Array1/markers/c.0.0"
    data = bytearray(shard.read_bytes())
    data[10 if "chunk" in harm else -3] ^= harm != "cut short"
    shard.write_bytes(data[:-200] if harm == "cut short" else data)
    with pytest.raises(SessionError, match=r"checksum|cut short|too short"):
        MarkerArchive(copy)["Array1"].packed([0, 1, 5])


@pytest.mark.parametrize(
    ("key", "value"),
    [("fill_value", 7), ("zarr_format", 2), ("storage_transformers", ["x"]), ("attributes", {})],
)
def test_changed_metadata_of_an_array_is_refused(copy: Path, key: str, value: object) -> None:
    path = copy / "Array1/markers/zarr.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(SessionError, match=f"markers.*found {key}"):
        MarkerArchive(copy)["Array1"].packed([0])


# ------------------------------------------------------------------------------------ writing


def test_an_archive_being_written_warns_and_shows_what_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.markers.zarr"
    writer = ArchiveWriter.begin(path, PLAN)
    write_units(writer, "Array1", [2])
    assert writer.missing() == {"Array1": [0, 1, 3], "Circle1": [0, 1, 2, 3]}
    opened = MarkerArchive(path)
    assert "still being written" in (opened.warning or "")
    np.testing.assert_array_equal(opened["Array1"].packed([12, 17]), PACKED[[12, 17]])
    with pytest.raises(SessionError, match="shard missing"):
        opened["Array1"].packed([0])
    with pytest.raises(SessionError, match="still being written"):
        opened["Array1"].table["depth"]
    with pytest.raises(SessionError, match="7 units are missing, first Array1 unit 0"):
        writer.finish()
    (finding,) = check(path)
    assert finding.code == "unfinished"
    assert "1 of 8 units are written" in finding.message
    assert main(["session", "info", str(path)]) == 0
    out = capsys.readouterr().out
    assert "status writing" in out
    assert "warning:" in out


@pytest.mark.slow
def test_order_repetition_and_many_writers_do_not_matter(archive: Path, tmp_path: Path) -> None:
    path = tmp_path / "a.markers.zarr"
    writer = ArchiveWriter.begin(path, PLAN)
    context = multiprocessing.get_context("fork")
    orders = ([3, 0, 2, 1], [1, 2, 0, 3], [1, 2, 3, 0])
    children = [
        context.Process(target=write_units, args=(ArchiveWriter(path), name, order))
        for order in orders
        for name in writer.sensors
    ]
    for child in children:
        child.start()
    for child in children:
        child.join()
    assert [child.exitcode for child in children] == [0] * 6
    writer.finish()
    assert digests(path) == digests(archive)
    write_units(writer, "Array1", [0])  # late, which must not matter
    writer.finish()
    assert digests(path) == digests(archive)
    assert make_archive(path) == path
    assert digests(path) == digests(archive)


@pytest.mark.parametrize("seed", few(range(30), 1))
def test_killed_at_random_and_restarted_the_bytes_are_the_same(seed: int, tmp_path: Path) -> None:
    many_units = ArchivePlan(
        tuple(replace(one, unit_rows=CHUNK) for one in PLAN.sensors), INDENTERS
    )
    dice, path = random.Random(seed), tmp_path / "a.markers.zarr"
    start = time.monotonic()
    undisturbed = make_archive(tmp_path / "undisturbed.markers.zarr", many_units)
    longest = time.monotonic() - start
    context = multiprocessing.get_context("fork")
    killed = 0
    while killed < 4:
        child = context.Process(target=make_archive, args=(path, many_units))
        child.start()
        time.sleep(dice.uniform(0.0, 0.6 * longest))
        os.kill(child.pid or 0, signal.SIGKILL)
        child.join()
        if child.exitcode == -signal.SIGKILL:
            killed += 1
        else:  # it had finished: start again, and wait for less time
            shutil.rmtree(path)
            longest *= 0.7
    make_archive(path, many_units)
    assert digests(path) == digests(undisturbed)
    assert check(path) == []


@pytest.mark.parametrize("step", [5, pytest.param(1, marks=pytest.mark.slow)])
def test_dying_in_front_of_any_file_operation_changes_no_byte(step: int, tmp_path: Path) -> None:
    small = ArchivePlan((plan("Circle1", rows=8, lattice=None),), INDENTERS)
    whole = make_archive(tmp_path / "whole.markers.zarr", small)
    with pytest.MonkeyPatch.context() as patch:
        counted = FailingCalls(patch, None)
        make_archive(tmp_path / "counted.markers.zarr", small)
    assert counted.calls > 60
    for fatal in range(1 + counted.calls % step, counted.calls + 1, step):
        path = tmp_path / f"{fatal}.markers.zarr"
        with pytest.MonkeyPatch.context() as patch:
            FailingCalls(patch, fatal)
            with pytest.raises(Killed):
                make_archive(path, small)
        make_archive(path, small)
        assert digests(path) == digests(whole)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"sensors": PLAN.sensors[:1]}, "zarr.json differs in sensors"),
        ({"indenters": ("sphere", "torus")}, "differs in indenters"),
        ({"rows": 24}, "displacement/zarr.json differs in shape"),
        ({"references": REFERENCES[::-1]}, "references/c.0.0 differs in the content"),
    ],
)
def test_another_plan_does_not_go_on_with_an_archive(
    changed: dict[str, Any], message: str, archive: Path
) -> None:
    before = digests(archive)
    if not {"sensors", "indenters"} & set(changed):
        changed = {"sensors": (plan(**changed), PLAN.sensors[1])}
    with pytest.raises(SessionError, match=message):
        ArchiveWriter.begin(archive, replace(PLAN, **changed))
    assert digests(archive) == before
    assert [entry.name for entry in archive.parent.iterdir()] == [archive.name]


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("name", "../Array1", "found name"),
        ("rows", 0, "expected at least 1"),
        ("unit_rows", 5, "multiple of chunk_rows 2"),
        ("references", REFERENCES[0], "expected uint8"),
        ("references", REFERENCES[:0], "expected 1 to 32767"),
        ("mm_per_px", float("nan"), "mm_per_px"),
        ("attrs", {"mm_per_px": 1}, "which the format sets itself"),
        ("displacement_of", "Circle1", "together with a lattice"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(field: str, value: Any, message: str) -> None:
    with pytest.raises(SessionError, match=message):
        plan(**{field: value})


def test_patterns_on_one_surface_share_its_displacement(tmp_path: Path) -> None:
    shared = plan("Circle1", lattice=None, displacement_of="Array1")
    path = make_archive(tmp_path / "a.markers.zarr", ArchivePlan((plan(), shared), INDENTERS))
    opened = MarkerArchive(path)
    np.testing.assert_array_equal(
        opened["Circle1"].displacement([3, 20]), opened["Array1"].displacement([3, 20])
    )
    assert opened["Circle1"].lattice == LATTICE
    assert not (path / "Circle1/displacement").exists()
    assert check(path) == []
    for wrong in (replace(shared, rows=22), replace(shared, displacement_of="Circle1")):
        with pytest.raises(SessionError, match=r"Circle1\.displacement_of: found"):
            ArchivePlan((plan(), wrong), INDENTERS)


def test_names_of_a_plan_must_differ_and_attributes_be_json(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="sensors: found"):
        ArchivePlan((plan(), plan()), INDENTERS)
    with pytest.raises(SessionError, match="indenters: found"):
        ArchivePlan((plan(),), ())
    with pytest.raises(SessionError, match="format sets itself"):
        ArchivePlan((plan(),), INDENTERS, {"status": "complete"})
    with pytest.raises(SessionError, match="not storable as JSON"):
        ArchiveWriter.begin(tmp_path / "a", ArchivePlan((plan(),), INDENTERS, {"x": {1, 2}}))
    assert list(tmp_path.iterdir()) == []


def changed_table(name: str, value: Any) -> dict[str, Any]:
    table = unit_of(slice(0, UNIT))["table"]
    values = np.array(table[name], np.float64 if isinstance(value, float) else None)
    values[2] = value
    return {**table, name: values}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"packed": PACKED[:5]}, r"found uint8 \(5, 38400\)"),
        ({"packed": PACKED[:UNIT].astype(np.int16)}, "found int16"),
        ({"displacement": None}, "found markers, expected markers, displacement"),
        ({"displacement": np.full((UNIT, *LATTICE.shape), np.inf, np.float16)}, "infinity"),
        ({"displacement": np.zeros((UNIT, *LATTICE.shape), np.float32)}, "found float32"),
        ({"source": ["one"] * 5}, "found 5 lines, expected 6"),
        ({"source": "sphere"}, "found one text"),
        ({"source": ["two\nlines"] * UNIT}, "expected one line of text"),
        ({"table": {"depth": np.zeros(UNIT)}}, "found columns depth"),
        ({"table": changed_table("depth", float("nan"))}, "depth: found nan in row 2; allowed"),
        ({"table": changed_table("wrench", [0, 0, np.inf, 0, 0, 0])}, "finite values, or NaN"),
        ({"table": changed_table("indenter", 2)}, "indenter: found 2 in row 2; allowed: 0 to 1"),
        ({"table": changed_table("phase", 4)}, "phase: found 4 in row 2; allowed: -1 to 3"),
        ({"table": changed_table("reference", 2)}, "allowed: 0 to 1"),
        ({"table": changed_table("frame", -1)}, "allowed: 0 and more"),
        ({"table": changed_table("target", 40_000)}, "out of range for int16"),
        ({"table": changed_table("location", 0.5)}, r"location: found float64 \(6,\)"),
    ],
)
def test_a_unit_that_is_not_as_planned_is_refused(
    given: dict[str, Any], message: str, tmp_path: Path
) -> None:
    writer = ArchiveWriter.begin(tmp_path / "a.markers.zarr", PLAN)
    with pytest.raises(SessionError, match=message):
        writer.sensors["Array1"].write(0, **{**unit_of(slice(0, UNIT)), **given})
    assert writer.missing()["Array1"] == [0, 1, 2, 3]
    with pytest.raises(SessionError, match="no unit 4, the sensor has 4"):
        writer.sensors["Array1"].rows_of(4)


def test_a_damaged_entry_of_the_ledger_is_named(tmp_path: Path) -> None:
    writer = ArchiveWriter.begin(tmp_path / "a.markers.zarr", PLAN)
    for name in writer.sensors:
        write_units(writer, name, range(4))
    entry = writer.sensors["Circle1"].ledger.path / "2.npz"
    entry.write_bytes(entry.read_bytes()[:100])
    with pytest.raises(SessionError, match=r"2\.npz: damaged .* write its unit again"):
        writer.finish()
    entry.write_bytes(entry.with_name("3.npz").read_bytes())  # the last unit is shorter
    with pytest.raises(SessionError, match=r"found .* for shard 0, expected"):
        writer.finish()
    assert not writer.complete
    entry.unlink()
    assert writer.missing() == {"Circle1": [2]}
    write_units(writer, "Circle1", [2])
    writer.finish()
    assert check(tmp_path / "a.markers.zarr") == []


# ----------------------------------------------------------------------------- location pairs


def group(
    indenters: int, targets: int, frames: int = 5, *, seed: int = 0
) -> dict[str, np.ndarray[Any, Any]]:
    """Return the table of a sensor, shuffled: every phase of every target with some frames."""
    dice = np.random.default_rng(seed)
    rows = []
    for indenter in range(indenters):
        for target in range(targets):
            count = frames + int(dice.integers(0, 2))
            phase = np.repeat(np.arange(4), count)
            location = indenter * targets + target
            same = np.full(4 * count, 1)
            columns = [location * same, indenter * same, target * same, phase]
            rows.append(np.stack([*columns, np.arange(4 * count)], axis=1))
    values = dice.permutation(np.concatenate(rows))
    names = ("location", "indenter", "target", "phase", "frame")
    table = dict(zip(names, values.T, strict=True))
    return {**table, "valid": np.ones(len(values), bool)}


@pytest.mark.parametrize(
    ("targets", "pairs"), [(240, 17_280), (48, 3_456), (160, 11_520)], ids=["homo", "mat", "hetero"]
)
@pytest.mark.parametrize("preset", few(["supplement", "authors_code"], 1))
def test_full_groups_have_the_papers_number_of_pairs(targets: int, pairs: int, preset: str) -> None:
    source, target = group(18, targets, seed=1), group(18, targets, 3, seed=2)
    found = location_pairs(source, target, preset)
    assert len(found) == pairs
    for name in ("location", "phase"):
        np.testing.assert_array_equal(source[name][found.source], target[name][found.target])
    assert len(np.unique(found.source)) == pairs


def test_a_pair_is_the_last_frame_of_each_phase_or_the_first_of_the_press() -> None:
    source, target = group(2, 3, seed=1), group(2, 3, seed=2)
    ends = location_pairs(source, target)
    for table, rows in ((source, ends.source), (target, ends.target)):
        for row in rows:
            same = (table["location"] == table["location"][row]) & (
                table["phase"] == table["phase"][row]
            )
            assert table["frame"][row] == table["frame"][same].max()
    authors = location_pairs(source, target, "authors_code")
    assert sorted(source["frame"][authors.source])[:6] == [0] * 6
    assert 3 not in source["phase"][authors.source]
    assert sorted(target["frame"][authors.target])[:6] == [0] * 6


def test_phases_and_locations_that_one_lacks_are_left_out() -> None:
    source, target = group(1, 4), group(1, 4)
    kept = ~((source["location"] == 2) & (source["phase"] >= 2))
    source = {name: values[kept] for name, values in source.items()}
    target["location"] = np.where(target["location"] == 3, -1, target["location"])
    assert len(location_pairs(source, target)) == 4 + 4 + 2
    assert len(location_pairs(target, source, "authors_code")) == 4 + 4 + 3


def test_frames_that_are_not_there_are_in_no_pair() -> None:
    source, target = group(1, 4), group(1, 4)
    source["valid"] = source["location"] != 2
    pairs = location_pairs(source, target)
    assert len(pairs) == 3 * 4
    assert 2 not in target["location"][pairs.target]
    assert len(location_pairs(target, source, "authors_code")) == 3 * 4


def test_states_without_phases_pair_one_to_one() -> None:
    states = np.arange(810)
    table = {
        "location": states,
        "indenter": states // 45,
        "target": states % 45 // 5,
        "phase": np.full(810, -1),
        "frame": states % 5,
        "valid": np.ones(810, bool),
    }
    for preset in ("supplement", "authors_code"):
        pairs = location_pairs(table, table, preset)
        np.testing.assert_array_equal(pairs.source, states)
        np.testing.assert_array_equal(pairs.target, states)


def test_a_location_of_two_presses_is_ambiguous() -> None:
    table = group(1, 2)
    table["location"][:] = 7
    with pytest.raises(SessionError, match="location 7: belongs to target 0 of indenter 0 and to"):
        location_pairs(table, group(1, 2))
    with pytest.raises(SessionError, match="known: supplement, authors_code"):
        location_pairs(table, table, "authors")


# ----------------------------------------------------------------------------- check and info


def share_fields_of_another_length(path: Path) -> None:
    shared = plan("Circle1", lattice=None, displacement_of="Array1")
    make_archive(
        path.parent / "b", ArchivePlan((plan(rows=12), replace(shared, rows=12)), INDENTERS)
    )
    shutil.rmtree(path / "Circle1")
    (path.parent / "b/Circle1").rename(path / "Circle1")


def attribute(path: str, **attrs: Any) -> Callable[[Path], Any]:
    return lambda archive: set_attributes(archive / path, **attrs)


def cell(column: str, row: int, value: Any) -> Callable[[Path], Any]:
    """Return a change of a value of the first sensor through Zarr, including checksums."""

    def change(archive: Path) -> None:
        array = zarr.open_array(archive / "Array1" / "table" / column, mode="r+")
        values = np.asarray(array)
        values[row] = value
        array[...] = values

    return change


def removed(path: str) -> Callable[[Path], Any]:
    return lambda archive: (archive / path).unlink()


def without_scale(archive: Path) -> None:
    edit_json(archive / "Array1/zarr.json", lambda d: d["attributes"].pop("mm_per_px"))


def shorter(archive: Path) -> None:
    edit_json(archive / TIME / "zarr.json", lambda d: d.update(shape=[ROWS - 1]))


TABLE, MARKERS, FIELD = "Array1/table", "Array1/markers", "Array1/displacement"
DEPTH, WRENCH, TIME = (f"{TABLE}/{name}" for name in ("depth", "wrench", "t_ns"))
FAULTS: dict[str, tuple[str, str, Callable[[Path], Any]]] = {
    "not closed": ("unfinished", ".", attribute(".", status="writing")),
    "a sensor without metadata": ("metadata", "Array1", removed(f"{MARKERS}/zarr.json")),
    "a sensor without a scale": ("metadata", "Array1", without_scale),
    "a column that is not there": ("metadata", "Array1", lambda p: shutil.rmtree(p / DEPTH)),
    "units of another kind": ("wrong-dtype", DEPTH, attribute(DEPTH, units="mm")),
    "a shorter column": ("unequal-lengths", TIME, shorter),
    "fields of another length": ("unequal-lengths", "Circle1", share_fields_of_another_length),
    "fields of no sensor": ("metadata", "Circle1", attribute("Circle1", displacement_of="Array2")),
    "fields from elsewhere": (
        "metadata",
        "Circle1",
        attribute("Circle1", displacement_of="../Array1"),
    ),
    "a shard that is not there": ("missing-chunk", MARKERS, removed(f"{MARKERS}/c.2.0")),
    "a bit in a column": ("bad-crc", WRENCH, lambda p: flip(p / WRENCH / "c.0.0", 40)),
    "a bit in a field": ("bad-crc", FIELD, lambda p: flip(p / FIELD / "c.1.0.0.0", 40)),
    "no depth": ("nan", DEPTH, cell("depth", 3, np.nan)),
    "an infinite force": ("nan", WRENCH, cell("wrench", 1, [1, np.inf, 0, 0, 0, 0])),
    "an indenter without a name": ("bad-code", f"{TABLE}/indenter", cell("indenter", 4, 9)),
    "a reference that is not there": ("bad-code", f"{TABLE}/reference", cell("reference", 4, 2)),
    "a source that is not there": ("bad-code", f"{TABLE}/source", cell("source", 4, 600)),
    "a file of a writer": ("left-behind", ".", lambda p: (p / MARKERS / "c.9.0.77-ab.tmp").touch()),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_planted_fault_is_found_and_nothing_else(name: str, copy: Path) -> None:
    code, where, plant = FAULTS[name]
    assert check(copy) == []
    plant(copy)
    assert [(finding.code, finding.where) for finding in check(copy)] == [(code, where)]


def archive_of_one(path: Path, sensor: SensorPlan, packed: Any = PACKED) -> Path:
    writer = ArchiveWriter.begin(path, ArchivePlan((sensor,), INDENTERS))
    for unit in range(writer.sensors["Array1"].units):
        rows = writer.sensors["Array1"].rows_of(unit)
        given = {**unit_of(rows, "Circle1"), "packed": packed[rows]}
        writer.sensors["Array1"].write(unit, **given)
    writer.finish()
    return path


def test_frames_that_lost_a_marker_are_flagged_with_share_and_rows(tmp_path: Path) -> None:
    lost, packed = mask_of(13), PACKED.copy()
    lost[200:250, 200:250] = False
    packed[13] = pack(lost)
    path = archive_of_one(tmp_path / "a.markers.zarr", plan(lattice=None), packed)
    (flag,) = marker_flags(MarkerArchive(path)["Array1"])
    assert (flag.row, flag.found, flag.expected) == (13, 129, 130)
    (finding,) = check(path)
    assert finding.code == "marker-count"
    assert finding.message.startswith("4.348% of the frames, row 13. row 13: 129 markers")
    for allowed in ({"smallest_px": 12, "tolerance": 1}, None):
        set_attributes(path / "Array1", marker_check=allowed)
        assert check(path) == []


def test_a_reference_without_markers_is_reported(tmp_path: Path) -> None:
    bare = plan(lattice=None, references=np.zeros_like(REFERENCES))
    (finding,) = check(archive_of_one(tmp_path / "a.markers.zarr", bare))
    assert finding.code == "marker-count"
    assert "found no patch" in finding.message
    uncounted = replace(bare, marker_count=None)
    assert check(archive_of_one(tmp_path / "b.markers.zarr", uncounted)) == []


def test_info_and_check_of_the_command_line_take_archives(
    archive: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["session", "info", str(archive)]) == 0
    out = capsys.readouterr().out
    assert f"{archive}  status complete, 2 sensor(s)" in out
    lines = {line.split()[0]: line.split() for line in out.splitlines() if line}
    assert lines["Array1"][1:5] == ["23", "2", "2", "130"]
    assert lines["Array1"][6:] == ["0.0339", "0.00", "2.20", *["-2.20", "0.00"] * 3]
    assert "made_from" in lines
    assert main(["session", "check", str(archive)]) == 0
    assert capsys.readouterr().out == f"{archive}: nothing found\n"
    (copy / "Circle1/markers/c.0.0").unlink()
    assert main(["session", "check", str(copy)]) == 1
    assert capsys.readouterr().out.startswith("missing-chunk   Circle1/markers: 3 found, first")


def test_rows_of_presses_are_in_order_of_frames_and_parted_by_phase() -> None:
    table = {
        "location": np.array([7, 3, 7, -1, 7, 3, 7]),
        "phase": np.array([1, 0, 0, 0, 1, 0, 0]),
        "frame": np.array([3, 1, 1, 0, 2, 0, 0]),
        "valid": np.array([True, True, True, True, True, True, False]),
    }
    found = {key: rows.tolist() for key, rows in press_rows(table).items()}
    assert found == {(3,): [5, 1], (7,): [2, 4, 0]}
    found = {key: rows.tolist() for key, rows in press_rows(table, "phase").items()}
    assert found == {(3, 0): [5, 1], (7, 0): [2], (7, 1): [4, 0]}
    assert press_rows({name: values[3:4] for name, values in table.items()}) == {}
