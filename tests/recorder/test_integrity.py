"""A changed byte is never read as data: checksums, manifests, bounded metadata, failed threads."""

import contextlib
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
import zarr
from support.crashes import FailingCalls, Killed
from support.sessions import T0, append_all, make_session, stream_columns

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
    repack,
)
from recorder.__main__ import main
from recorder.session.frames import write_frames
from recorder.session.reader import Stream
from recorder.session.recover import recover_streams
from recorder.store.images import compress, decode_jpeg, decompress
from recorder.store.layout import StreamLayout, create_stream
from recorder.store.manifest import seal

# Recorded by format version 1: no checksums in the chunks, no manifest.
OLD = Path(__file__).parents[1] / "golden" / "data"


@pytest.fixture(scope="module")
def jpeg_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_session(tmp_path_factory.mktemp("jpeg") / "s.zarr", seconds=1.2, shape=(16, 24))


@pytest.fixture(scope="module")
def lossless_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("lossless") / "s.zarr"
    return make_session(path, seconds=1.2, shape=(16, 24), codec="zstd", names=("camera", "force"))


def columns_of(stream: Stream) -> dict[str, Any]:
    found = {name: stream.array(name) for name in stream.small}
    if stream.layout.image is not None:
        found["images"] = stream.images(slice(None))
    return found


def zarr_columns(stream: Stream) -> dict[str, Any]:
    arrays = (layout.path for layout in stream.layout.columns)
    return {path.name: np.asarray(zarr.open_array(path, mode="r")) for path in arrays}


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(np.array_equal(a[name], b[name], equal_nan=a[name].dtype.kind == "f") for name in b)


def flip(path: Path, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


@pytest.mark.parametrize("kind", ["jpeg_session", "lossless_session"])
def test_a_flipped_bit_in_a_shard_is_refused_or_changes_no_value(
    kind: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    path = tmp_path / "s.zarr"
    shutil.copytree(request.getfixturevalue(kind), path)
    session, dice = Session(path), random.Random(7)
    rejected = 0
    for name, stream in session.streams.items():
        good, good_zarr = columns_of(stream), zarr_columns(stream)
        for shard in sorted(p for p in stream.layout.path.glob("*/c/**/*") if p.is_file()):
            whole = shard.read_bytes()
            for _ in range(3):
                flip(shard, dice.randrange(8 * len(whole)))
                try:
                    assert same(columns_of(Stream(stream.layout.path)), good), f"{name} {shard}"
                except SessionError:
                    rejected += 1
                with contextlib.suppress(ValueError, RuntimeError):
                    assert same(zarr_columns(stream), good_zarr), f"{name} {shard}"
                shard.write_bytes(whole)
    assert rejected > 10


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


@pytest.mark.parametrize("name", ["gelsight.zarr", "uskin.zarr"])
def test_sessions_of_format_1_open_are_verified_by_their_records_and_can_be_resumed(
    name: str, tmp_path: Path
) -> None:
    path = tmp_path / name
    shutil.copytree(OLD / name, path)
    session = Session(path)
    good = {name: columns_of(stream) for name, stream in session.streams.items()}
    shard = session.streams["force"].layout.columns[0].shard(0)
    whole = shard.read_bytes()
    for bit in range(8 * 30, 8 * 60, 11):  # of the first chunk
        flip(shard, bit)
        with pytest.raises(SessionError, match="does not match its checksum"):
            Session(path).streams["force"].array("value")
        shard.write_bytes(whole)
    writer = SessionWriter.resume(path)
    writer.begin_run({"t0_ns": 0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
    with StreamWriter.open(writer.stream_path("force")) as force:
        force.append(value=np.ones(6), seq=1, status=0, t_ns=10**18)
    writer.finish("stopped", rate_hz=40)
    resumed = Session(path)
    assert len(resumed.streams["force"]) == len(good["force"]["t_ns"]) + 1
    for stream, columns in good.items():
        count = len(columns["t_ns"])
        found = {k: v[:count] for k, v in columns_of(resumed.streams[stream]).items()}
        assert same(found, columns)


def edit(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


HOSTILE: dict[str, tuple[str, Callable[[dict[str, Any]], Any], str]] = {
    "72 TiB of rows": (
        "streams/force/value",
        lambda d: d.update(shape=[10**13, 6]),
        "allowed: up to",
    ),
    "negative rows": ("streams/force/value", lambda d: d.update(shape=[-1, 6]), "found shape"),
    "a row of 2^40 values": (
        "streams/force/value",
        lambda d: d.update(shape=[5, 1 << 40]),
        "found shape",
    ),
    "shape not a list": ("streams/force/value", lambda d: d.update(shape="x"), "found shape"),
    "a chunk of 2^40 rows": (
        "streams/force/value",
        lambda d: d["codecs"][0]["configuration"].update(chunk_shape=[1 << 40, 6]),
        "found chunk_shape",
    ),
    "1e12 Hz": (
        "streams/force",
        lambda d: d["attributes"].update(rate_hz=1e12),
        "found rate_hz 1000000000000.0; allowed: above 0 to 1e",
    ),
    "rate that is text": (
        "streams/force",
        lambda d: d["attributes"].update(rate_hz="fast"),
        "found rate_hz 'fast'",
    ),
    "rate of the session": (".", lambda d: d["attributes"].update(rate_hz=1e12), "found rate_hz"),
    "runs not a list": (".", lambda d: d["attributes"].update(runs={"a": 1}), "found runs"),
    "a run that is a number": (".", lambda d: d["attributes"].update(runs=[3]), r"found runs\[0\]"),
    "a run that starts before the one before": (
        ".",
        lambda d: d["attributes"].update(
            runs=[{"first_row": {"force": 5}}, {"first_row": {"force": 4}}]
        ),
        r"found runs\[1\] first_row force 4; allowed: 5 to",
    ),
    "unknown status": (".", lambda d: d["attributes"].update(status="fine"), "found status 'fine'"),
    "a table of 10^12 rows": (
        "targets/planned",
        lambda d: d.update(shape=[10**12, 3]),
        "chunk missing",
    ),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_impossible_metadata_is_refused_by_name(case: str, tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    shutil.copytree(OLD / "gelsight.zarr", path)
    where, change, message = HOSTILE[case]
    edit(path / where / "zarr.json", change)

    def read() -> None:
        session = Session(path)
        columns_of(session.streams["force"])
        dict(session.targets)

    with pytest.raises(SessionError, match=message):
        read()


def test_rows_that_one_column_alone_declares_are_named_and_not_read(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    shutil.copytree(OLD / "gelsight.zarr", path)
    before = Session(path).streams["force"].array("value")
    edit(path / "streams/force/value/zarr.json", lambda d: d.update(shape=[10**12, 6]))
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
    (path / "value" / "zarr.json").write_text("garbled")  # read when a shard is sealed

    def record() -> None:
        for t_ns in range(100_000):
            writer.append(**row, t_ns=t_ns)

    with pytest.raises(SessionError, match=r"recording stopped.*not readable as JSON"):
        record()
    accepted = writer.rows
    with pytest.raises(SessionError, match="not readable as JSON"):
        writer.close()
    shutil.copy(path / "seq" / "zarr.json", path / "value" / "zarr.json")
    edit(path / "value" / "zarr.json", lambda d: d.update(_as_value(d)))
    StreamWriter.open(path).close()
    assert len(Stream(path)) == accepted


def _as_value(document: dict[str, Any]) -> dict[str, Any]:
    """Return the metadata of `value` (n, 6) float64 after that of a scalar column."""
    grid = document["chunk_grid"]["configuration"]["chunk_shape"]
    codecs = document["codecs"]
    codecs[0]["configuration"]["chunk_shape"].append(6)
    return {
        "shape": [document["shape"][0], 6],
        "data_type": "float64",
        "fill_value": "NaN",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [*grid, 6]}},
        "codecs": codecs,
        "attributes": {"units": "N, N m", "description": "d"},
        "dimension_names": ["row", "axis"],
    }


# Sealed sessions of every origin, with files changed, removed or exchanged.


def imported(folder: Path) -> Path:
    table = np.column_stack([np.arange(200) / 100, np.random.default_rng(1).normal(size=(200, 6))])
    names = "t (s),Fx (N),Fy (N),Fz (N),Tx (Nm),Ty (Nm),Tz (Nm)"
    np.savetxt(folder / "force.csv", table, delimiter=",", header=names, comments="")
    np.save(folder / "taxels.npy", np.random.default_rng(2).integers(0, 9, (120, 16, 3)))
    arguments = ["--force", folder / "force.csv", "--taxels", folder / "taxels.npy"]
    options = ["--taxels-hz", "60", "--sensor", "a", "--indenter", "b"]
    assert main(["import", str(folder / "s.zarr"), *map(str, [*arguments, *options])]) == 0
    return folder / "s.zarr"


def resumed(folder: Path) -> Path:
    path = make_session(folder / "s.zarr", seconds=1.2, names=("force", "pose"))
    for run in (1, 2):
        with SessionWriter.resume(path) as session:
            session.begin_run({"t0_ns": T0, "utc": "2026-01-01T00:00:00Z", "boot_id": "b"})
            columns = stream_columns("force", 0.5, (4, 4), "zstd", seed=run)
            append_all(session.stream_path("force"), {**columns, "t_ns": columns["t_ns"] + run})
            session.finish("complete", rate_hz=40)
    return path


def recovered(folder: Path) -> Path:
    path = make_session(folder / "s.zarr", seconds=1.2, finish=False)
    recover(path)
    return path


def repacked(folder: Path) -> Path:
    repack(OLD / "uskin.zarr", folder / "s.zarr", "camera")
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
    "repacked from format 1": repacked,
}


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    made: dict[str, Path] = {}

    def make(kind: str) -> Path:
        if kind not in made:
            made[kind] = SEALED[kind](tmp_path_factory.mktemp("sealed"))
        return made[kind]

    return make


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


@pytest.mark.parametrize("kind", SEALED)
def test_a_sealed_session_has_no_finding_and_says_so_quickly(
    kind: str, sealed: Callable[[str], Path]
) -> None:
    path = sealed(kind)
    assert faults(check(path, quick=True)) == []
    assert [f for f in check(path) if f.code in ("manifest", "not-sealed", "bad-crc")] == []
    assert recover(path).touched is False


def flips_are_never_read(path: Path, flips: int, seed: int) -> None:
    """Flip bits one after the other; every one must be refused, or change nothing that is read."""
    good, dice = everything(path), random.Random(seed)
    files = files_of(path)
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


def check_any(path: Path, *, quick: bool = False) -> list[Finding]:
    try:
        return check(path, quick=quick)
    except SessionError as error:
        return [Finding("metadata", ".", str(error))]


@pytest.mark.parametrize("kind", SEALED)
def test_a_flipped_bit_anywhere_is_refused_or_changes_nothing(
    kind: str, sealed: Callable[[str], Path], tmp_path: Path
) -> None:
    shutil.copytree(sealed(kind), tmp_path / "s.zarr")
    flips_are_never_read(tmp_path / "s.zarr", 8, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SEALED)
def test_three_hundred_flipped_bits_are_refused_or_change_nothing(
    kind: str, sealed: Callable[[str], Path], tmp_path: Path
) -> None:
    shutil.copytree(sealed(kind), tmp_path / "s.zarr")
    flips_are_never_read(tmp_path / "s.zarr", 300, seed=2)


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
            if where.parts[0] != "manifest" and unchanged(path, good):
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


@pytest.mark.parametrize("kind", SEALED)
def test_a_file_removed_cut_or_replaced_is_named(
    kind: str, sealed: Callable[[str], Path], tmp_path: Path
) -> None:
    shutil.copytree(sealed(kind), tmp_path / "s.zarr")
    other = sealed("lossless" if kind == "jpeg" else "jpeg")
    assert losses(tmp_path / "s.zarr", other, kind, every=9) > 20


@pytest.mark.slow
@pytest.mark.parametrize("kind", SEALED)
def test_every_file_removed_cut_or_replaced_is_named(
    kind: str, sealed: Callable[[str], Path], tmp_path: Path
) -> None:
    shutil.copytree(sealed(kind), tmp_path / "s.zarr")
    other = make_session(tmp_path / "other.zarr", names=("camera", "taxels", "force", "pose"))
    assert losses(tmp_path / "s.zarr", other, kind, every=1) > 150


def test_a_file_added_after_closing_is_named(sealed: Callable[[str], Path], tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    shutil.copytree(sealed("jpeg"), path)
    shutil.copytree(path / "streams/force", path / "streams/gauge")
    named = {finding.where for finding in check(path, quick=True)}
    assert "streams/gauge/zarr.json" in named
    assert set(Session(path).streams) == {"camera", "force", "pose"}


def test_a_run_changes_no_shard_of_the_runs_before_it(
    sealed: Callable[[str], Path], tmp_path: Path
) -> None:
    path = tmp_path / "s.zarr"
    shutil.copytree(sealed("resumed"), path)
    shutil.rmtree(path / "manifest" / "1")
    with pytest.raises(SessionError, match=r"manifest/1/zarr\.json: missing"):
        Session(path)
    assert [f.where for f in check(path, quick=True)] == ["manifest"]
    with pytest.raises(SessionError, match=r"manifest/1/zarr\.json: missing"):
        SessionWriter.resume(path)
    with pytest.raises(SessionError, match=r"manifest/1/zarr\.json: missing"):
        recover(path)


def test_what_was_changed_in_a_closed_session_is_not_sealed_by_resuming(
    sealed: Callable[[str], Path], tmp_path: Path
) -> None:
    path = tmp_path / "s.zarr"
    shutil.copytree(sealed("jpeg"), path)
    edit(path / "streams/force/zarr.json", lambda d: d["attributes"].update(bias=[1.0] * 6))
    before = (path / "zarr.json").read_bytes()
    for attempt in (SessionWriter.resume, recover):
        with pytest.raises(SessionError, match="differs from the manifest of run 0"):
            attempt(path)
    assert (path / "zarr.json").read_bytes() == before


def test_sealing_survives_a_kill_before_each_file_operation(tmp_path: Path) -> None:
    origin = make_session(tmp_path / "s.zarr", seconds=0.5, names=("force",), finish=False)
    recover_streams(origin)
    write_frames(origin, 40)
    call = 0
    finished = False
    while not finished:
        call += 1
        path = tmp_path / "killed.zarr"
        shutil.copytree(origin, path)
        with pytest.MonkeyPatch.context() as patch, contextlib.suppress(Killed):
            FailingCalls(patch, call)
            seal(path, status="complete")
            finished = True
        assert Session(path).status in ("complete", *(() if finished else ("recording",)))
        recover(path)
        assert check(path, quick=True) == []
        assert len(Session(path).streams["force"]) == 500
        shutil.rmtree(path)
    assert call > 8
