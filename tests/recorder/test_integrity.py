"""A changed byte is never read as data: checksums, manifests, bounded metadata, failed threads."""

import contextlib
import json
import random
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
import zarr
from support.crashes import FailingCalls, Killed
from support.sessions import edit_json, flip, make_session, record_run, stream_columns

from recorder import (
    Finding,
    Session,
    SessionError,
    SessionWriter,
    StreamWriter,
    check,
    faults,
    force_spec,
    recover,
)
from recorder.convert import export
from recorder.session.columns import Stream
from recorder.session.frames import write_frames
from recorder.session.stream_writer import recover_streams
from recorder.store.images import compress, decode_jpeg, decompress
from recorder.store.layout import StreamLayout, create_stream
from recorder.store.manifest import seal
from tactile.__main__ import main

pytestmark = pytest.mark.slow


def columns_of(stream: Stream) -> dict[str, Any]:
    found = {name: stream.array(name) for name in stream.small}
    if stream.layout.image is not None:
        found["images"] = stream.images(slice(None))
    return found


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in b)


def test_a_swapped_chunk_is_refused_although_its_own_checksum_matches(tmp_path: Path) -> None:
    create_stream(tmp_path / "force", force_spec(1000))
    with StreamWriter.open(tmp_path / "force") as writer:
        for t_ns in range(2048):
            writer.append(value=np.arange(6.0), seq=1, status=5 + t_ns // 1024, t_ns=t_ns)
    (layout,) = (
        c for c in StreamLayout.load(tmp_path / "force").columns if c.path.name == "status"
    )
    data = layout.shard(0).read_bytes()
    offsets = np.frombuffer(data[-1028:-4], "<u8").reshape(64, 2)[:2].astype(int)
    first, second = (data[start : start + size] for start, size in offsets)
    assert len(first) == len(second)
    assert first != second
    changed = data[: offsets[0, 0]] + second + data[offsets[0].sum() :]
    layout.shard(0).write_bytes(changed)
    with pytest.raises(SessionError, match=r"chunk 0 \(row 0\) does not match its checksum"):
        Stream(tmp_path / "force").array("status")


def unsealed(folder: Path) -> Path:
    """Return a session as it was in its first run, when no manifest stood before other checks."""
    path = make_session(folder / "s.zarr", seconds=1.2)
    shutil.rmtree(path / "manifest")
    set_attrs_of(path, ".", status="recording")
    return path


def set_attrs_of(path: Path, where: str, **attrs: Any) -> None:
    edit_json(path / where / "zarr.json", lambda d: d["attributes"].update(attrs))


VALUE = "streams/force/value"
HOSTILE: dict[str, tuple[str, dict[str, Any], str]] = {
    "72 TiB of rows": (VALUE, {"shape": [10**13, 6]}, "allowed: up to"),
    "negative rows": (VALUE, {"shape": [-1, 6]}, "found shape"),
    "a row of 2^40 values": (VALUE, {"shape": [5, 1 << 40]}, "found shape"),
    "shape not a list": (VALUE, {"shape": "x"}, "found shape"),
    "a chunk of 2^40 rows": (VALUE, {"chunk_shape": [1 << 40, 6]}, "found chunk_shape"),
    "a table of 10^12 rows": ("targets/planned", {"shape": [10**12, 3]}, "chunk missing"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_impossible_metadata_is_refused_by_name(case: str, tmp_path: Path) -> None:
    path = unsealed(tmp_path)
    where, changes, message = HOSTILE[case]

    def change(document: dict[str, Any]) -> None:
        shard = document["codecs"][0]["configuration"]
        (shard if "chunk_shape" in changes else document).update(changes)

    edit_json(path / where / "zarr.json", change)
    with pytest.raises(SessionError, match=message):  # noqa: PT012
        session = Session(path)
        columns_of(session.streams["force"])
        dict(session.targets)


NOT_SECONDS = [float("nan"), float("inf"), -1.0, 1e300, "0.01", True, [0.01], {"s": 1}]


@pytest.mark.parametrize("key", ["latency", "exposure", "max_age"])
def test_a_time_that_alignment_reads_is_refused_by_name_if_none(key: str, tmp_path: Path) -> None:
    path = unsealed(tmp_path)
    for value in NOT_SECONDS:
        set_attrs_of(path, "streams/force", **{key: value})
        allowed = rf"streams/force: found {key} .*; allowed: (0|-0.5) to "
        with pytest.raises(SessionError, match=allowed):
            Session(path)
    codes = [finding.code for finding in faults(check_any(path))]
    assert codes[:2] == ["unfinished", "metadata"]


def with_fit(**piece: Any) -> dict[str, Any]:
    good = {"first_row": 0, "rows": 9, "offset_s": 1.0, "drift_ppm": 1.0, "residual_rms_s": 0.1}
    knots = {"knots_device_t": [0.0, 1.0], "knots_host_minus_device": [0.0, 0.0]}
    fit = {"method": "causal", "window_s": 30.0, "wrap_s": None, "clock": "device_t"}
    return {"clock_fit": [None, {**fit, "pieces": [{**good, **knots, **piece}]}]}


BOUNDED: list[tuple[str, dict[str, Any], str]] = [
    ("streams/force", {"bias": [1.0] * 5 + [float("nan")]}, "found bias"),
    ("streams/force", {"bias": [1e300] * 6}, "found bias"),
    ("streams/force", {"bias": [0.0] * 100_000}, "found bias .*; allowed: up to 4096 numbers"),
    ("streams/force", {"columns": ["value", "value", "t_ns"]}, "found columns .*, expected each"),
    (".", {"runs": [{"first_row": {}}] * 5000}, "found runs .*; allowed: a list of up to 4096"),
    ("streams/force", {"bias": "zero"}, "found bias 'zero'"),
    ("streams/force", {"device": "F/T"}, "found device 'F/T'; allowed: a JSON object"),
    ("streams/force", {"device": {"rate_hz": 1e300}}, "device: found rate_hz 1e"),
    ("streams/force", {"axes_measured": [1, 2]}, "found axes_measured"),
    ("streams/force", {"stamp": "dawn"}, "found stamp 'dawn'; known: start"),
    ("streams/force", {"latency_calibration": [0, 1]}, "found latency_calibration"),
    (
        "streams/force",
        {"latency_calibration": {"interval_s": [0.0, float("inf")]}},
        "latency_calibration: found interval_s",
    ),
    ("streams/force", {"clock_fit": {}}, "found clock_fit"),
    ("streams/force", with_fit(drift_ppm=float("nan")), r"pieces\[0\]: found drift_ppm nan"),
    ("streams/force", with_fit(rows=-1), r"found rows -1; allowed: a whole number"),
    ("streams/force", with_fit(knots_device_t=[0.0, 1e300]), "found knots_device_t"),
    ("streams/force", {"roles": {"a": 1}}, "found roles"),
    (".", {"contact_frame": [0.0] * 5 + [1e300]}, "found contact_frame"),
    (".", {"contact_frame": [0.0] * 7}, "found contact_frame .*; allowed: 6 numbers"),
    (".", {"replay_of": {"speed": float("nan")}}, "replay_of: found speed nan"),
    (".", {"replay_of": "s.zarr"}, "found replay_of 's.zarr'"),
    (".", {"t0_ns": 1e300}, "found t0_ns 1e"),
    (".", {"targets_wanted": -5}, "found targets_wanted -5"),
    (".", {"rebuilding": "recording"}, "found rebuilding 'recording'; allowed: complete"),
    (".", {"sealed_later": [{"lost": "all"}]}, "found lost 'all'"),
    (".", {"rate_hz": float("nan")}, "found rate_hz nan"),
    (".", {"rate_hz": 1e12}, "found rate_hz"),
    ("streams/force", {"rate_hz": 1e12}, "found rate_hz 1000000000000.0; allowed: above 0 to 1e"),
    ("streams/force", {"rate_hz": "fast"}, "found rate_hz 'fast'"),
    (".", {"runs": {"a": 1}}, "found runs"),
    (".", {"runs": [3]}, r"found runs\[0\]"),
    (
        ".",
        {"runs": [{"first_row": {"force": 5}}, {"first_row": {"force": 4}}]},
        r"found runs\[1\] first_row force 4; allowed: 5 to",
    ),
    (".", {"status": "fine"}, "found status 'fine'"),
]


@pytest.mark.parametrize(("where", "attrs", "message"), BOUNDED)
def test_every_attribute_that_is_computed_with_is_bounded_by_name(
    where: str, attrs: dict[str, Any], message: str, tmp_path: Path
) -> None:
    path = unsealed(tmp_path)
    set_attrs_of(path, where, **attrs)
    with pytest.raises(SessionError, match=message):
        Session(path)


def test_attributes_that_readers_refuse_cannot_be_written(tmp_path: Path) -> None:
    frame = {"contact_frame": [0.0] * 5}
    specs = [force_spec(100)]
    with pytest.raises(SessionError, match="found contact_frame"):
        SessionWriter.create(tmp_path / "s.zarr", attrs=frame, streams=specs, targets={})
    late = [force_spec(100, latency=-1.0)]
    with pytest.raises(SessionError, match=r"found latency -1\.0; allowed: -0\.5 to 60"):
        SessionWriter.create(tmp_path / "s.zarr", attrs={}, streams=late, targets={})
    # Counted from the end of an exposure, whose middle the signal shows.
    specs = [force_spec(100, latency=-0.006)]
    with SessionWriter.create(tmp_path / "s.zarr", attrs={}, streams=specs, targets={}) as session:
        with pytest.raises(SessionError, match="found contact_frame"):
            session.set_attrs(**frame)
        session.set_attrs(contact_frame=tuple(np.zeros(6)), t0_ns=np.int64(5))
        with pytest.raises(SessionError, match="found t0_ns 'now'"):
            session.begin_run({"t0_ns": "now"})
        session.finish("complete", rate_hz=40)
    assert check(tmp_path / "s.zarr", quick=True) == []


def test_metadata_that_is_nested_or_large_without_end_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = unsealed(tmp_path)
    for text, message in (("[" * 100_000, "not readable as JSON"), ('{"attributes": 1}', "found")):
        (path / "zarr.json").write_text(text)
        with pytest.raises(SessionError, match=message):
            Session(path)
    monkeypatch.setattr("recorder.store.documents.DOCUMENT_MAX", 10)
    with pytest.raises(SessionError, match="17 bytes; allowed for metadata: 10"):
        Session(path)


def segments_with(column: str, value: int) -> Callable[[str, dict[str, Any]], dict[str, Any]]:
    def change(name: str, columns: dict[str, Any]) -> dict[str, Any]:
        if name == "segments":
            columns[column] = np.full(len(columns[column]), value, columns[column].dtype)
        return columns

    return change


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("end_ns", 9 * 10**18, r"a phase of .*e\+09 s at 40 Hz; allowed"),
        ("run", 77, "no run 77; runs: 1"),
    ],
)
def test_phases_of_centuries_and_of_unknown_runs_are_refused_before_ticks_are_made(
    column: str, value: int, message: str, tmp_path: Path
) -> None:
    change = segments_with(column, value)
    with pytest.raises(SessionError, match=message):
        make_session(tmp_path / "s.zarr", seconds=1.0, names=("force",), change=change)


@pytest.mark.parametrize("target", [10**9, -7])
def test_a_phase_of_an_unknown_target_is_found_and_the_session_can_be_closed(
    target: int, tmp_path: Path
) -> None:
    change = segments_with("target", target)
    make_session(tmp_path / "s.zarr", seconds=1.0, names=("force",), change=change)
    found = [one.message for one in check(tmp_path / "s.zarr") if one.code == "segment-outside"]
    assert found[0].startswith(f"row 0: found target {target}, there are")


def test_rows_that_one_column_alone_declares_are_named_and_not_read(tmp_path: Path) -> None:
    path = unsealed(tmp_path)
    before = Session(path).streams["force"].array("value")
    edit_json(path / VALUE / "zarr.json", lambda d: d.update(shape=[10**12, 6]))
    assert np.array_equal(Session(path).streams["force"].array("value"), before)
    assert {"unequal-lengths", "missing-chunk"} <= {one.code for one in check(path)}


def test_a_jpeg_is_refused_by_its_header_before_its_pixels_are_decoded() -> None:
    small = bytearray(simplejpeg.encode_jpeg(np.zeros((16, 24, 3), np.uint8)))
    size = small.index(b"\xff\xc0") + 5
    small[size : size + 4] = (65500).to_bytes(2, "big") * 2
    with pytest.raises(SessionError, match=r"found \(65500, 65500\), expected \(16, 24, 3\)"):
        decode_jpeg(bytes(small), (16, 24, 3))


@pytest.mark.parametrize("nbytes", [1, 255, 256, 300, 65_791, 65_792, 200_000])
def test_a_zstd_frame_is_refused_by_the_length_it_declares(nbytes: int) -> None:
    frame = compress(bytes(nbytes))
    assert decompress(frame, nbytes) == bytes(nbytes)
    with pytest.raises(SessionError, match=f"found {nbytes} bytes, expected {nbytes + 1}"):
        decompress(frame, nbytes + 1)


def test_any_error_of_the_background_thread_stops_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "force"
    create_stream(path, force_spec(50))  # 64 rows a block, 64 blocks a shard
    row = {"value": np.arange(6.0), "seq": 1, "status": 0}
    writer = StreamWriter.open(path, sync_interval=0.01)
    metadata = path / "value" / "zarr.json"  # read when a shard is sealed
    whole = metadata.read_text()
    metadata.write_text("garbled")

    def record() -> None:
        for t_ns in range(100_000):
            writer.append(**row, t_ns=t_ns)

    with pytest.raises(SessionError, match=r"recording stopped.*not readable as JSON"):
        record()
    accepted = writer.rows
    with pytest.raises(SessionError, match="not readable as JSON"):
        writer.close()
    metadata.write_text(whole)
    StreamWriter.open(path).close()
    assert len(Stream(path)) == accepted


# Sealed sessions of every origin, with files changed, removed or exchanged.


def imported(folder: Path) -> Path:
    table = np.column_stack([np.arange(200) / 100, np.random.default_rng(1).normal(size=(200, 6))])
    names = "t (s),Fx (N),Fy (N),Fz (N),Tx (Nm),Ty (Nm),Tz (Nm)"
    np.savetxt(folder / "force.csv", table, delimiter=",", header=names, comments="")
    np.save(folder / "taxels.npy", np.random.default_rng(2).integers(0, 9, (120, 16, 3)))
    arguments = ["--force", folder / "force.csv", "--taxels", folder / "taxels.npy"]
    options = ["--taxels-hz", "60", "--sensor", "a", "--indenter", "b"]
    options += ["--press", "none", "--lag", "0", "--yes"]
    assert main(["import", str(folder / "s.zarr"), *map(str, [*arguments, *options])]) == 0
    return folder / "s.zarr"


def resumed(folder: Path) -> Path:
    path = make_session(folder / "s.zarr", seconds=1.2, names=("force", "pose"))
    for run in (1, 2):
        columns = stream_columns("force", 0.5, (4, 4), "zstd", seed=run)
        record_run(path, {"force": {**columns, "t_ns": columns["t_ns"] + run}})
    return path


def replayed(folder: Path) -> Path:
    from support.replayable import as_devices_send

    from rig.replay.replay import Replay, ReplayRequest

    source = make_session(folder / "source.zarr", seconds=1.2, change=as_devices_send)
    assert Replay(ReplayRequest(source, folder / "s.zarr", speed=0.0)).run() == 0
    return folder / "s.zarr"


def recovered(folder: Path) -> Path:
    path = make_session(folder / "s.zarr", seconds=1.2, finish=False)
    recover(path)
    return path


def copied(folder: Path) -> Path:
    source = make_session(folder / "t.zarr", seconds=1.2, names=("taxels", "force", "pose"))
    export(source, folder / "s.zarr", "zarr")
    return folder / "s.zarr"


SHORT: dict[str, Any] = {"seconds": 1.2, "shape": (16, 24)}
SEALED: dict[str, Callable[[Path], Path]] = {
    "jpeg": lambda folder: make_session(folder / "s.zarr", **SHORT),
    "lossless": lambda folder: make_session(folder / "s.zarr", codec="zstd", **SHORT),
    "taxels": lambda folder: make_session(
        folder / "s.zarr", seconds=1.2, names=("taxels", "force", "pose")
    ),
    "imported": imported,
    "resumed": resumed,
    "recovered": recovered,
    "copied": copied,
    "replayed": replayed,
}
# Flips read by plain Zarr in each session, spread evenly over its shards.
FLIPS_OF_ZARR = 100
# A replay starts emulators of all its devices.
KINDS = [
    pytest.param(kind, marks=[pytest.mark.slow, pytest.mark.serial] if kind == "replayed" else [])
    for kind in SEALED
]
# A whole recording, a recovered one and a copy run by default, the others if slow.
FEW = ("jpeg", "recovered", "copied")
SAMPLED = [
    pytest.param(
        *kind.values, marks=[*kind.marks, *([] if kind.values[0] in FEW else [pytest.mark.slow])]
    )
    for kind in KINDS
]


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    made: dict[str, Path] = {}

    def make(kind: str) -> Path:
        if kind not in made:
            made[kind] = SEALED[kind](tmp_path_factory.mktemp("sealed"))
        return made[kind]

    return make


@pytest.fixture
def copy_of(sealed: Callable[[str], Path], tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that copies the sealed session of a kind, for a test to harm it."""
    return lambda kind: Path(shutil.copytree(sealed(kind), tmp_path / "s.zarr"))


def everything(path: Path) -> dict[str, Any]:
    """Return all that `Session` gives: attributes, columns, images, tables."""
    session = Session(path)
    found: dict[str, Any] = {"attrs": json.dumps(session.attrs), "runs": str(session.runs)}
    for name, stream in session.streams.items():
        found |= {f"{name}.{key}": value for key, value in columns_of(stream).items()}
        found[f"{name} attrs"] = json.dumps(stream.attrs)
        column = stream.layout.columns[0].column
        found[f"{name} units"] = f"{column.units} {column.description} {column.dims}"
    for name in ("targets", "segments", "reference", "frames"):
        table = getattr(session, name)
        found |= {f"{name}.{key}": table[key] for key in table}
    return found


def alike(a: dict[str, Any], b: dict[str, Any]) -> bool:
    texts = [key for key, value in b.items() if isinstance(value, str)]
    if set(a) != set(b) or any(a[key] != b[key] for key in texts):
        return False
    return same(a, {key: value for key, value in b.items() if key not in texts})


def files_of(path: Path) -> list[Path]:
    return sorted(file for file in path.rglob("*") if file.is_file())


@pytest.mark.parametrize("kind", KINDS)
def test_a_sealed_session_has_no_finding_and_says_so_quickly(
    kind: str, sealed: Callable[[str], Path]
) -> None:
    path = sealed(kind)
    assert faults(check(path, quick=True)) == []
    assert [f for f in check(path) if f.code in ("manifest", "not-sealed", "bad-crc")] == []
    assert recover(path).touched is False


@pytest.mark.parametrize("kind", ["jpeg", "lossless"])
def test_a_flipped_bit_in_a_shard_is_refused_or_changes_no_value(
    kind: str, copy_of: Callable[[str], Path]
) -> None:
    dice, rejected = random.Random(7), 0
    for name, stream in Session(copy_of(kind)).streams.items():
        good = columns_of(stream)
        for shard in sorted(p for p in stream.layout.path.glob("*/c/**/*") if p.is_file()):
            whole = shard.read_bytes()
            for _ in range(3):
                flip(shard, dice.randrange(8 * len(whole)))
                try:
                    assert same(columns_of(Stream(stream.layout.path)), good), f"{name} {shard}"
                except SessionError:
                    rejected += 1
                shard.write_bytes(whole)
    assert rejected > 10


def check_any(path: Path, *, quick: bool = False) -> list[Finding]:
    try:
        return check(path, quick=quick)
    except SessionError as error:
        return [Finding("metadata", ".", str(error))]


@pytest.mark.parametrize(
    "flips", [8, pytest.param(300, marks=[pytest.mark.slow, pytest.mark.timeout(600)])]
)
@pytest.mark.parametrize("kind", SAMPLED)
def test_a_flipped_bit_anywhere_is_refused_or_changes_nothing(
    kind: str, flips: int, copy_of: Callable[[str], Path]
) -> None:
    path, dice = copy_of(kind), random.Random(flips)
    good, files = everything(path), files_of(path)
    for _ in range(flips):
        file = dice.choice(files)
        whole = file.read_bytes()
        bit = dice.randrange(8 * len(whole))
        flip(file, bit)
        try:
            assert alike(everything(path), good), f"{file} bit {bit} was read"
        except SessionError:
            assert faults(check_any(path)), f"{file} bit {bit}: refused, but check finds nothing"
        file.write_bytes(whole)


@pytest.mark.parametrize("kind", SAMPLED)
def test_a_flipped_bit_in_a_sealed_chunk_is_refused_by_plain_zarr_or_changes_nothing(
    kind: str, copy_of: Callable[[str], Path]
) -> None:
    path, dice, refused = copy_of(kind), random.Random(3), 0
    shards = {
        shard: (layout.path, np.asarray(zarr.open_array(layout.path, mode="r")))
        for stream in Session(path).streams.values()
        for layout in stream.layout.columns
        for shard in files_of(layout.path / "c")
    }
    for flip_number in range(FLIPS_OF_ZARR):
        shard = list(shards)[flip_number % len(shards)]
        array, good = shards[shard]
        whole = shard.read_bytes()
        bit = dice.randrange(8 * len(whole))
        flip(shard, bit)
        try:
            found = np.asarray(zarr.open_array(array, mode="r"))
        except (ValueError, RuntimeError):
            refused += 1
        else:
            equal_nan = found.dtype.kind == "f"
            assert np.array_equal(found, good, equal_nan=equal_nan), f"{shard} bit {bit} was read"
        shard.write_bytes(whole)
    assert refused > FLIPS_OF_ZARR // 2


def unchanged(path: Path, good: dict[str, Any]) -> bool:
    try:
        return alike(everything(path), good)
    except SessionError:
        return False


def losses(path: Path, other: Path, kind: str, every: int) -> int:
    """Remove, cut and replace files in turn; return the number of changes, all of them named."""
    changes, good = 0, everything(path)
    for file in files_of(path)[::every]:
        where = file.relative_to(path)
        whole = file.read_bytes()
        variants: list[bytes | None] = [None, whole[:-1], whole[: len(whole) // 2], b""]
        if (other / where).exists() and (other / where).read_bytes() != whole:
            variants.append((other / where).read_bytes())
        for data in variants:
            file.unlink() if data is None else file.write_bytes(data)
            if "c" in where.parts and unchanged(path, good):
                file.write_bytes(whole)
                continue  # equal values with the same checksums, recorded at another time
            named = [str(f) for f in faults([*check_any(path, quick=True)])]
            group = str(where.parent).partition("/c/")[0]
            # A manifest of another session differs from all files instead.
            named_it = named if group.startswith("manifest") else [n for n in named if group in n]
            assert named_it, f"{kind} {where}: check says {named[:3]}"
            with pytest.raises(SessionError):
                everything(path)
            file.write_bytes(whole)
            changes += 1
    assert faults(check_any(path, quick=True)) == []
    return changes


@pytest.mark.parametrize("kind", SAMPLED)
def test_a_file_removed_cut_or_replaced_is_named(
    kind: str, sealed: Callable[[str], Path], copy_of: Callable[[str], Path]
) -> None:
    other = sealed("lossless" if kind == "jpeg" else "jpeg")
    assert losses(copy_of(kind), other, kind, every=9) > 20


@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", KINDS)
def test_every_file_removed_cut_or_replaced_is_named(
    kind: str, copy_of: Callable[[str], Path], tmp_path: Path
) -> None:
    other = make_session(tmp_path / "other.zarr", names=("camera", "taxels", "force", "pose"))
    assert losses(copy_of(kind), other, kind, every=1) > 150


def test_metadata_of_a_table_replaced_or_removed_is_named_and_refused(
    copy_of: Callable[[str], Path],
) -> None:
    path = copy_of("jpeg")
    for name in ("targets", "frames"):
        file = path / name / "zarr.json"
        whole = file.read_bytes()
        same_values = json.dumps(json.loads(whole)).encode()
        for data in (same_values, None):
            file.unlink() if data is None else file.write_bytes(data)
            for quick in (True, False):
                assert f"{name}/zarr.json" in {f.where for f in check(path, quick=quick)}
            with pytest.raises(SessionError, match=rf"{name}/zarr\.json"):
                Session(path)
        file.write_bytes(whole)
    Session(path)


def test_a_file_added_after_closing_is_named(copy_of: Callable[[str], Path]) -> None:
    path = copy_of("jpeg")
    shutil.copytree(path / "streams/force", path / "streams/gauge")
    named = {finding.where for finding in check(path, quick=True)}
    assert "streams/gauge/zarr.json" in named
    assert set(Session(path).streams) == {"camera", "force", "pose"}


def test_a_run_changes_no_shard_of_the_runs_before_it(copy_of: Callable[[str], Path]) -> None:
    path = copy_of("resumed")
    shutil.rmtree(path / "manifest" / "1")
    with pytest.raises(SessionError, match=r"manifest/1/zarr\.json: missing"):
        Session(path)
    assert [f.where for f in check(path, quick=True)] == ["manifest"]
    with pytest.raises(SessionError, match=r"manifest/1/zarr\.json: missing"):
        SessionWriter.resume(path)


def test_what_was_changed_in_a_closed_session_is_not_sealed_by_resuming(
    copy_of: Callable[[str], Path],
) -> None:
    path = copy_of("jpeg")
    set_attrs_of(path, "streams/force", bias=[1.0] * 6)
    before = (path / "zarr.json").read_bytes()
    for attempt in (SessionWriter.resume, recover):
        with pytest.raises(SessionError, match="differs from the manifest of run 0"):
            attempt(path)
    assert (path / "zarr.json").read_bytes() == before


def lose_manifests(path: Path, *runs: int) -> None:
    for run in runs:
        shutil.rmtree(path / "manifest" / str(run))


@pytest.mark.parametrize("lost", [(0,), (1,), (2,), (0, 1, 2)])
def test_a_session_that_lost_only_manifests_can_be_read_and_is_sealed_again_by_recover(
    lost: tuple[int, ...], copy_of: Callable[[str], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    path = copy_of("resumed")
    good = everything(path)
    lose_manifests(path, *lost)
    named = f"manifest/{max(lost)}/zarr.json: missing"
    with pytest.raises(SessionError, match=rf"{named}.*session recover makes it again"):
        Session(path)
    accepted = Session(path, unsealed=True)
    assert named in (accepted.warning or "")
    assert np.array_equal(accepted.streams["force"].array("value"), good["force.value"])
    assert main(["session", "recover", str(path)]) == 0
    runs = ", ".join(map(str, lost))
    assert f"the manifest of run {runs} was lost and made again" in capsys.readouterr().out
    again = everything(path)
    assert json.loads(again.pop("attrs")).pop("sealed_later")[0]["lost"] == list(lost)
    good.pop("attrs")
    assert alike(again, good)
    note = next(one for one in check(path) if one.code == "sealed-later")
    assert f"the manifest of run {runs} was lost and made again on 2" in note.message
    assert faults(check(path, quick=True)) == []
    assert Session(path).warning is None
    assert not recover(path).touched
    flip(path / "streams/force/zarr.json", 999)
    with pytest.raises(SessionError, match="differs from the manifest of run 2"):
        Session(path)


def cut_a_shard(path: Path) -> None:
    shard = path / "streams/force/value/c/0/0"
    shard.write_bytes(shard.read_bytes()[:-1])


@pytest.mark.parametrize(
    "harm",
    [
        cut_a_shard,
        lambda path: flip(path / VALUE / "c/0/0", 8 * 300),
        lambda path: shutil.rmtree(path / "streams/pose"),
        lambda path: shutil.rmtree(path / "targets/depth"),
        lambda path: (path / "streams/force/seq/c/0").rename(path / "streams/force/seq/c/1"),
        lambda path: edit_json(path / "streams/force/seq/zarr.json", lambda d: d.update(shape=[5])),
    ],
)
def test_a_session_that_lost_more_than_its_manifest_is_not_sealed_again(
    harm: Callable[[Path], Any], copy_of: Callable[[str], Path]
) -> None:
    path = copy_of("taxels")
    lose_manifests(path, 0)
    harm(path)
    before = {file: file.read_bytes() for file in files_of(path)}
    with pytest.raises(SessionError, match=r"only if nothing but its manifest is lost|missing"):
        recover(path)
    assert {file: file.read_bytes() for file in files_of(path)} == before


def test_a_file_that_the_remaining_manifest_contradicts_is_not_sealed_again(
    copy_of: Callable[[str], Path],
) -> None:
    path = copy_of("resumed")
    lose_manifests(path, 0)
    set_attrs_of(path, "streams/force", bias=[1.0] * 6)
    with pytest.raises(SessionError, match="only if nothing but its manifest is lost"):
        recover(path)


def killed_at_each_operation(origin: Path, action: Callable[[Path], Any]) -> Iterator[bool]:
    """Yield before a copy is removed: killed before each file operation, and whole at last."""
    path, call, finished = origin.parent / "killed.zarr", 0, False
    while not finished:
        call += 1
        shutil.copytree(origin, path)
        with pytest.MonkeyPatch.context() as patch, contextlib.suppress(Killed):
            FailingCalls(patch, call)
            action(path)
            finished = True
        yield finished
        shutil.rmtree(path)
    assert call > 8


@pytest.mark.parametrize("lost", [pytest.param("frames", marks=pytest.mark.slow), "manifest/0"])
def test_a_complete_session_stays_complete_if_its_repair_is_killed_at_any_point(
    lost: str, tmp_path: Path
) -> None:
    origin = make_session(tmp_path / "s.zarr", seconds=0.2, names=("force",))
    shutil.rmtree(origin / lost)
    path = tmp_path / "killed.zarr"
    for _ in killed_at_each_operation(origin, recover):
        recover(path)
        assert faults(check(path, quick=True)) == []
        assert Session(path).status == "complete"
        assert "rebuilding" not in Session(path).attrs


def test_sealing_survives_a_kill_before_each_file_operation(tmp_path: Path) -> None:
    origin = make_session(tmp_path / "s.zarr", seconds=0.5, names=("force",), finish=False)
    recover_streams(origin)
    write_frames(origin, 40)
    path = tmp_path / "killed.zarr"
    for finished in killed_at_each_operation(origin, partial(seal, status="complete")):
        assert Session(path).status in ("complete", *(() if finished else ("recording",)))
        recover(path)
        assert check(path, quick=True) == []
        assert len(Session(path).streams["force"]) == 500


@pytest.mark.parametrize("change", ["status", "stream", "foreign"])
def test_status_manifest_and_streams_that_disagree_are_named(change: str, tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("force", "pose"), seconds=1.2)
    edit_json(path / "zarr.json", lambda each: each["attributes"].update(status="recording"))
    if change == "stream":
        force = path / "streams/force/zarr.json"
        edit_json(force, lambda each: each["attributes"].update(latency=0.02))
    if change == "foreign":
        shutil.rmtree(path / "manifest")
        shutil.copytree(path / "streams/pose", path / "streams/other")
    named = {each.where for each in check(path) if each.code == "manifest"}
    if change == "status":
        assert not named
        assert recover(path).status == "recovered"
        return
    assert named == {"streams/other" if change == "foreign" else "streams/force/zarr.json"}
    with pytest.raises(SessionError, match=r"does not declare|differs from the manifest"):
        recover(path)
