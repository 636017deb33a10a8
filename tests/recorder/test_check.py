"""Each planted fault is found at its place, with no other findings."""

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.sessions import T0, edit_json, flip, make_session, reseal

from recorder import Session, SessionError, StreamWriter, faults
from recorder.checks.check import check
from recorder.cli import check as check_command
from recorder.findings import CODES, Finding
from recorder.session.frames import write_frames
from recorder.store.manifest import seal
from tactile.__main__ import main

Columns = dict[str, Any]


def only_in(name: str, change: Callable[[Columns], Columns]) -> Callable[[str, Columns], Columns]:
    """Return a change that affects one stream only."""
    return lambda stream, columns: change(columns) if stream == name else columns


def without(rows: slice) -> Callable[[Columns], Columns]:
    """Return a change that drops rows."""

    def change(columns: Columns) -> Columns:
        keep = np.delete(np.arange(len(columns["t_ns"])), rows)
        return {name: [values[row] for row in keep] for name, values in columns.items()}

    return change


def repeated(rows: slice) -> Callable[[Columns], Columns]:
    """Return a change that repeats the first value of some rows in all of them."""

    def change(columns: Columns) -> Columns:
        values = list(columns["value"])
        values[rows] = [values[rows.start]] * len(values[rows])
        return {**columns, "value": values}

    return change


def shifted(column: str, rows: slice, by: Any) -> Callable[[Columns], Columns]:
    """Return a change that adds an offset to a column in some rows."""

    def change(columns: Columns) -> Columns:
        values = np.array(columns[column])
        values[rows] += by
        return {**columns, column: values}

    return change


def slowed(rows: slice, factor: float) -> Callable[[Columns], Columns]:
    """Return a change that stretches the times of some rows, and leaves out those past the end."""

    def change(columns: Columns) -> Columns:
        t_ns = np.array(columns["t_ns"])
        end = t_ns[-1]
        t_ns[rows] = t_ns[rows.start] + (t_ns[rows] - t_ns[rows.start]) * factor
        kept = t_ns <= end
        values = {name: np.asarray(column)[kept] for name, column in columns.items()}
        return {**values, "t_ns": t_ns[kept]}

    return change


def clipped(columns: Columns) -> Columns:
    return {**columns, "value": np.maximum(columns["value"], -3.0)}


IMAGES, POSES, FORCES, PHASES = (
    partial(only_in, name) for name in ("camera", "pose", "force", "segments")
)
CAMERA, FORCE, POSE = "streams/camera", "streams/force", "streams/pose"
RECORDED: dict[str, tuple[str, str, Callable[[str, Columns], Columns]]] = {
    "frozen image": ("frozen", CAMERA, IMAGES(repeated(slice(50, 140)))),
    "frozen force": ("frozen", FORCE, FORCES(repeated(slice(500, 1700)))),
    "gap in images": ("dropped", CAMERA, IMAGES(without(slice(60, 70)))),
    "gap in poses": ("dropped", POSE, POSES(without(slice(60, 70)))),
    "repeated time": ("time-order", POSE, POSES(shifted("t_ns", slice(70, 71), -8_300_000))),
    "host clock steps forward": (
        "clock-step",
        CAMERA,
        IMAGES(shifted("t_ns", slice(100, None), 250_000_000)),
    ),
    "host clock steps back": (
        "clock-step",
        CAMERA,
        IMAGES(shifted("t_ns", slice(100, None), -250_000_000)),
    ),
    "device clock restarts": (
        "clock-step",
        POSE,
        POSES(shifted("device_t", slice(200, None), -1.5)),
    ),
    "device pauses and loses no number": (
        "gap",
        FORCE,
        FORCES(shifted("t_ns", slice(1500, None), 250_000_000)),
    ),
    "repeated number": ("seq-order", f"{FORCE}/seq", FORCES(shifted("seq", slice(900, None), -1))),
    "few samples dropped": ("dropped", FORCE, FORCES(without(slice(900, 903)))),
    "many samples dropped": ("dropped", FORCE, FORCES(without(slice(900, 1100)))),
    "device slows down and loses no number": (
        "rate",
        FORCE,
        FORCES(slowed(slice(1200, None), 1.5)),
    ),
    "stream ends early": ("truncated", POSE, POSES(without(slice(250, None)))),
    "empty stream": ("truncated", POSE, POSES(without(slice(0, None)))),
    "force clipped by its device": ("clipped", f"{FORCE}/value", FORCES(clipped)),
    "NaN": ("nan", f"{FORCE}/value", FORCES(shifted("value", slice(7, 8), np.nan))),
    "phase before the streams": (
        "segment-outside",
        "segments",
        PHASES(shifted("start_ns", slice(0, 1), -400_000_000)),
    ),
    "phase of a target that is not there": (
        "segment-outside",
        "segments",
        PHASES(shifted("target", slice(2, 3), 50)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", RECORDED)
def test_a_fault_in_what_was_recorded_is_found_and_only_it(fault: str, tmp_path: Path) -> None:
    code, where, change = RECORDED[fault]
    extra = 50 if fault == "phase of a target that is not there" else 0
    path = make_session(tmp_path / "s.zarr", change=change, finish=not extra)
    if extra:
        write_frames_without_offsets(path)
        seal(path, status="stopped")
    assert [(finding.code, finding.where) for finding in faults(check(path))] == [(code, where)]


def write_frames_without_offsets(path: Path) -> None:
    """Build frames for a session whose segments refer to missing targets."""
    aside = shutil.move(path / "targets" / "point", path.parent / "point")
    write_frames(path, 40)
    shutil.move(aside, path / "targets" / "point")
    edit_json(path / "zarr.json", lambda d: d["attributes"].update(rate_hz=40))


def cut_jpeg(session: Path) -> None:
    """Replace a session's images by truncated ones."""

    def change(columns: Columns) -> Columns:
        values = list(columns["value"])
        values[5] = values[5][:-40]
        return {**columns, "value": values}

    shutil.rmtree(session)
    make_session(session, change=only_in("camera", change))


def edited(path: str, edit: Callable[[dict[str, Any]], Any]) -> Callable[[Path], Any]:
    return lambda session: edit_json(session / path / "zarr.json", edit)


def removed(path: str) -> Callable[[Path], Any]:
    def remove(session: Path) -> None:
        file = session / path
        shutil.rmtree(file) if file.is_dir() else file.unlink()

    return remove


def flipped(path: str, place: int) -> Callable[[Path], Any]:
    return lambda session: flip(session / path, 8 * place + 2)


def written(path: str, data: bytes) -> Callable[[Path], Any]:
    return lambda session: (session / path).write_bytes(data)


def cut(path: str) -> Callable[[Path], Any]:
    return lambda session: (session / path).write_bytes((session / path).read_bytes()[:-9])


def append_segment(session: Path) -> None:
    """Add a phase that the frames view does not contain."""
    row = {"target": [0], "phase": [0], "outcome": [0], "run": [0]}
    times = {"start_ns": [T0 + 3_400_000_000], "end_ns": [T0 + 3_500_000_000]}
    with StreamWriter.open(session / "segments") as stream:
        stream.append(**{name: values[0] for name, values in {**row, **times}.items()})


VALUE, SEQ, IMAGE = f"{FORCE}/value", f"{FORCE}/seq", f"{CAMERA}/value"
SHARD, IMAGE_SHARD = f"{VALUE}/c/0/0", f"{IMAGE}/c/0/0/0/0"
ON_DISK: dict[str, tuple[str, str, Callable[[Path], Any]]] = {
    "status never written": (
        "unfinished",
        ".",
        edited(".", lambda d: d["attributes"].update(status="recording")),
    ),
    "broken metadata": ("metadata", FORCE, written(f"{FORCE}/zarr.json", b"{")),
    "shard missing": ("missing-chunk", IMAGE, removed(IMAGE_SHARD)),
    "chunk missing": ("missing-chunk", SEQ, removed(f"{SEQ}/c/0")),
    "chunk of a table missing": ("missing-chunk", "targets/depth", removed("targets/depth/c/0")),
    "flipped bit in an image": ("bad-crc", IMAGE, flipped(IMAGE_SHARD, 700)),
    "flipped bit in a value": ("bad-crc", VALUE, flipped(SHARD, 5000)),
    "flipped bit in a record's time": ("bad-crc", VALUE, flipped(SHARD, 14)),
    "flipped bit in an index": ("bad-crc", IMAGE, flipped(IMAGE_SHARD, -100)),
    "flipped bit in the frames": ("bad-crc", "frames/wrench", flipped("frames/wrench/c/0/0", -300)),
    "shard cut short": ("bad-crc", VALUE, cut(SHARD)),
    "torn tail": ("torn-tail", CAMERA, written(f"{IMAGE_SHARD}.partial", b"TRL1 and then nothing")),
    "journal left": ("journal-left", FORCE, written(f"{FORCE}/t_ns/journal-3600", b"")),
    "wrong dtype": ("wrong-dtype", SEQ, edited(SEQ, lambda d: d.update(data_type="float64"))),
    "wrong unit": (
        "wrong-dtype",
        VALUE,
        edited(VALUE, lambda d: d["attributes"].update(units="kg")),
    ),
    "no unit": ("missing-units", VALUE, edited(VALUE, lambda d: d["attributes"].pop("units"))),
    "unequal lengths": ("unequal-lengths", FORCE, edited(SEQ, lambda d: d.update(shape=[3000]))),
    "frames of other segments": ("frames-length", "frames", append_segment),
    "stream removed": ("missing-array", FORCE, removed(FORCE)),
    "column of the frames removed": ("missing-array", "frames/wrench", removed("frames/wrench")),
    "column of the targets removed": ("missing-array", "targets/depth", removed("targets/depth")),
    "frames missing": ("frames-length", "frames", removed("frames")),
    "image without an end": ("bad-image", IMAGE, cut_jpeg),
}


@pytest.mark.parametrize("fault", ON_DISK)
def test_a_fault_on_the_disk_is_found_and_only_it(fault: str, tmp_path: Path) -> None:
    code, where, plant = ON_DISK[fault]
    path = make_session(tmp_path / "s.zarr")
    plant(path)
    if fault in NOT_IN_THE_MANIFEST:
        assert "manifest" not in {finding.code for finding in check(path)}
    else:
        assert "manifest" in {finding.code for finding in check(path, quick=True)}
        reseal(path)
    assert [(finding.code, finding.where) for finding in faults(check(path))] == [(code, where)]


# Flipped bits that only a reading of all data finds, and changes before the session was closed.
NOT_IN_THE_MANIFEST = (
    "status never written",
    "flipped bit in an image",
    "flipped bit in a value",
    "flipped bit in a record's time",
    "image without an end",
)


def test_every_code_has_a_planted_fault() -> None:
    planted = {code for code, _, _ in (*RECORDED.values(), *ON_DISK.values())}
    assert planted | {"manifest"} == set(CODES)


def test_a_source_that_is_said_to_be_still_may_repeat_itself(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", change=only_in("force", repeated(slice(500, 1700))))
    edit_json(path / FORCE / "zarr.json", lambda d: d["attributes"].update(source_motion="still"))
    reseal(path)
    assert faults(check(path)) == []


@pytest.mark.parametrize(("rates", "found"), [({}, ["rate"]), ({"force": 1250.0}, [])])
def test_a_rate_is_held_against_that_before_the_recording(
    tmp_path: Path, rates: dict[str, float], found: list[str]
) -> None:
    path = make_session(tmp_path / "s.zarr", change=only_in("force", slowed(slice(0, None), 0.8)))
    edit_json(path / "zarr.json", lambda d: d["attributes"]["runs"][0].update(rates_hz=rates))
    reseal(path)
    assert [each.code for each in faults(check(path)) if each.code == "rate"] == found


@pytest.mark.parametrize(("stream", "late"), [("camera", 3), ("camera", 9), ("pose", 10)])
def test_late_packets_are_no_clock_step(tmp_path: Path, stream: str, late: int) -> None:
    """A busy host delays some samples and then takes them all; the clocks still agree."""

    def stall(columns: Columns) -> Columns:
        t_ns = np.array(columns["t_ns"])
        t_ns[100 : 100 + late] = t_ns[100 + late] - 1000 * np.arange(late, 0, -1)
        return {**columns, "t_ns": t_ns}

    path = make_session(tmp_path / "s.zarr", change=only_in(stream, stall))
    assert [finding.code for finding in faults(check(path))] == ["gap"] * (late == 9)


def test_reading_a_missing_chunk_is_an_error_not_a_zero(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr")
    (path / FORCE / "value/c/0/0").unlink()
    with pytest.raises(SessionError, match=r"value/c/0/0: missing; the manifest of run 0 names it"):
        Session(path)


def test_what_is_no_session_is_said_to_be_none(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="no such session"):
        check(tmp_path / "nowhere")
    (tmp_path / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group"}')
    with pytest.raises(SessionError, match="found format None"):
        check(tmp_path)


@pytest.mark.parametrize(
    ("signal", "codec"), [("camera", "jpeg"), ("camera", "zstd"), ("taxels", "jpeg")]
)
def test_nothing_is_found_in_a_sound_session(signal: str, codec: str, tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=(signal, "force", "pose"), codec=codec)
    assert faults(check(path)) == []
    session = Session(path)
    assert session.warning is None
    assert session.frames["valid"].all()


def test_a_note_is_printed_and_does_not_fail_the_check(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    note = Finding("sealed-later", ".", "no manifest")
    fault = Finding("gap", CAMERA, "found one")
    monkeypatch.setattr(check_command, "check", lambda session, quick: [note])
    assert main(["session", "check", str(recorded)]) == 0
    assert "sealed-later    note: .: no manifest" in capsys.readouterr().out
    monkeypatch.setattr(check_command, "check", lambda session, quick: [note, fault])
    assert main(["session", "check", str(recorded)]) == 1
    assert faults([note, fault]) == [fault]
