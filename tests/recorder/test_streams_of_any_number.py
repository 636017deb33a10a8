"""Sessions with none, one and three streams of each kind: everything goes by streams, not names."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.sessions import (
    T0,
    append_all,
    edit_json,
    make_session,
    record_run,
    reseal,
    set_attrs,
    specs,
    stream_columns,
)

from recorder import (
    Session,
    SessionError,
    SessionWriter,
    StreamSpec,
    StreamWriter,
    camera_spec,
    check,
    contact_sheet,
    depth_spec,
    event_row,
    event_text,
    events_spec,
    faults,
    force_spec,
    pose_spec,
    recover,
    taxels_spec,
)
from recorder.convert.export import export
from recorder.info import describe, digests
from recorder.spec import KINDS
from tests.support.few import few

pytestmark = pytest.mark.slow

Mixed = tuple[Path, tuple[str, ...]]

FOUR = ("camera", "force", "pose", "taxels")


def several(kind: str, count: int) -> tuple[str, ...]:
    return (kind, *(f"{kind}_{number}" for number in range(2, count + 1)))[:count]


# All kinds but one, three of each, and the extremes.
MIXES = {f"no-{kind}": tuple(other for other in FOUR if other != kind) for kind in FOUR}
MIXES |= {
    "three-of-each": tuple(name for kind in FOUR for name in several(kind, 3)),
    "only-gauges": several("force", 3),
    "all-kinds": (*FOUR, "depth_1", "joints_1", "events_1"),
}


@pytest.fixture(scope="module", params=few(MIXES, 3))
def mixed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Mixed:
    path, names = tmp_path_factory.mktemp("mixed") / "s.zarr", MIXES[request.param]
    return make_session(path, names=names, seconds=1.9, shape=(16, 24)), names


def test_every_aligned_stream_has_a_column_of_frames(mixed: Mixed) -> None:
    path, names = mixed
    session, count = Session(path), len(Session(path).frames["t_ns"])
    assert session.order == list(names)
    for name, column in session.columns.items():
        stream = session.streams[name]
        value, kind = stream.value_column, stream.traits.kind
        assert value is not None
        assert column == (KINDS[kind].column if name == session.first(kind) else "") or name
        assert session.frames[column].shape == (count, *(value.shape if value.is_number else ()))
        if column == name and KINDS[kind].column != name:
            assert np.nanmax(np.abs(session.frames[f"{name}_age"])) < 1
    assert np.isnan(session.frames["wrench"]).all() == ("force" not in names)
    assert (session.frames["image"] == -1).all() == ("camera" not in names)
    assert session.frames["valid"][2:-2].all()


def test_values_of_frames_are_those_of_their_stream_at_the_capture(mixed: Mixed) -> None:
    path, _ = mixed
    session, row = Session(path), 20
    frames = session.frames
    tick = int(frames["t_ns"][row])
    signal = session.signal
    assert signal == next((n for k in ("camera", "taxels") for n in session.of_kind(k)), None)
    capture = tick
    if signal is not None:
        times = session.streams[signal].t_ns
        capture = int(times[np.searchsorted(times, tick, side="right") - 1])
    for name, column in session.columns.items():
        stream, found = session.streams[name], frames[column][row]
        held = int(np.searchsorted(stream.t_ns, capture, side="right")) - 1
        if stream.traits.align == "latest":
            assert found == held
            continue
        value = stream.array("value")
        number = int(name.partition("_")[2] or 1)
        # Of its own reference; that of the first gauge has no torque.
        offset = np.repeat([0.25 * number, 0.25 * number * (number > 1)], 3)
        if stream.traits.align == "mean" and signal is None:  # no exposure: at the tick
            found, offset = found + offset, np.zeros(6)
        if stream.traits.align == "mean" and signal is not None:
            exposure = 10_000_000 if signal == "camera" else round(1e9 / 60)
            lit = (stream.t_ns >= capture - exposure) & (stream.t_ns <= capture)
            np.testing.assert_allclose(found, value[lit].mean(axis=0) - offset, atol=1e-9)
        elif name == signal:
            np.testing.assert_array_equal(found, value[held])
        else:
            low, high = (np.minimum, np.maximum)
            around = value[held : held + 2].astype(float)
            assert (found >= low.reduce(around) - 1e-9).all()
            assert (found <= high.reduce(around) + 1e-9).all()


def test_a_window_holds_all_streams_and_the_pixels_of_every_camera(mixed: Mixed) -> None:
    path, _ = mixed
    session = Session(path)
    window = session.window(int(session.frames["t_ns"][30]), 3)
    assert list(window.streams) == list(session.columns)
    assert window.valid.all()
    for name, aligned in window.streams.items():
        stream = session.streams[name]
        if stream.layout.image is not None:
            assert aligned.row is not None
            np.testing.assert_array_equal(aligned.value, stream.images(aligned.row))
    for field, column in (("image", "image"), ("wrench", "wrench"), ("pose", "pose")):
        assert (getattr(window, field) is None) == (column not in session.columns.values())


def test_check_info_digest_and_sheet_take_any_streams(mixed: Mixed, tmp_path: Path) -> None:
    path, names = mixed
    assert faults(check(path)) == []
    assert set(names) <= set(describe(path).split())
    assert set(digests(Session(path))) == set(names)
    contact_sheet(path, tmp_path / "sheet.png")
    with Image.open(tmp_path / "sheet.png") as picture:
        assert picture.width > 100


def test_a_killed_recording_is_recovered_with_all_its_rows(mixed: Mixed, tmp_path: Path) -> None:
    _, names = mixed
    path = tmp_path / "s.zarr"
    with SessionWriter.create(path, attrs={}, streams=specs(names, (16, 24), "jpeg"), targets={}):
        pass
    rows = {}
    for name in names:
        columns = stream_columns(name, 0.8, (16, 24), "jpeg", seed=2)
        # Left open: what a kill leaves behind.
        writer = StreamWriter.open(path / "streams" / name, sync_interval=30)
        for row in range(len(columns["t_ns"])):
            writer.append(**{column: values[row] for column, values in columns.items()})
        rows[name] = writer.rows
        writer._background.stop()
        shutil.copytree(path / "streams" / name, tmp_path / "copy" / name)
        writer.close()
        shutil.rmtree(path / "streams" / name)
        (tmp_path / "copy" / name).rename(path / "streams" / name)
    assert recover(path).status == "recovered"
    assert {name: len(stream) for name, stream in Session(path).streams.items()} == rows
    assert faults(check(path)) == []


@pytest.mark.parametrize("to", ["hdf5", "mcap", "lerobot", "genforce"])
def test_every_export_takes_any_streams(mixed: Mixed, to: str, tmp_path: Path) -> None:
    path, names = mixed
    out = tmp_path / "out"
    if to == "genforce" and not {"camera", "taxels"} & set(names):
        with pytest.raises(SessionError, match="has neither camera nor taxels"):
            export(path, out, to)
        return
    export(path, out, to)
    {"hdf5": _hdf5, "mcap": _mcap, "lerobot": _lerobot, "genforce": _genforce}[to](path, out)


def _hdf5(path: Path, out: Path) -> None:
    import h5py

    with h5py.File(out) as file:
        assert set(file["streams"]) == set(Session(path).streams)
        for name, stream in Session(path).streams.items():
            assert len(file[f"streams/{name}/t_ns"]) == len(stream)
        assert set(file["frames"]) == set(Session(path).frames)


def _mcap(path: Path, out: Path) -> None:
    from mcap.reader import make_reader

    session, counts = Session(path), dict[str, int]()
    with out.open("rb") as file:
        for _, channel, _ in make_reader(file).iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
    poses = sum(len(session.streams[name]) for name in session.of_kind("pose"))
    assert counts.pop("/tf", 0) == poses
    topics = {"camera": "/camera", "force": "/wrench", "pose": "/pose", "taxels": "/taxels"}
    for name, stream in session.streams.items():
        first = session.first(stream.traits.kind) == name
        topic = topics.get(stream.traits.kind, f"/{name}") if first else f"/{name}"
        assert counts.pop(topic) == len(stream)
    assert set(counts) <= {"/segments", "/reference"}


def _lerobot(path: Path, out: Path) -> None:
    session = Session(path)
    features = json.loads((out / "meta/info.json").read_text())["features"]
    observed = [name for name in features if name.startswith("observation.")]
    assert len(observed) == len(session.columns)
    import pyarrow.parquet as pq

    (file,) = (out / "data").rglob("*.parquet")
    table = pq.read_table(file)
    for name, column in session.columns.items():
        if session.streams[name].traits.kind == "events":
            texts = table[f"observation.{name}"].to_pylist()
            rows = session.frames[column]
            assert texts[-1] == event_text(session.streams[name].array("value")[rows[-1]])
    assert set(features) == set(table.column_names)


def _genforce(path: Path, out: Path) -> None:
    session, base = Session(path), out / "wedge"
    folders = {"camera": "image", "taxels": "uskin_raw", "force": "force", "pose": "pose"}
    expected = {"path"}
    for kind, folder in folders.items():
        for place, name in enumerate(session.of_kind(kind)):
            expected.add(folder if place == 0 else f"{folder}_{name}")
    assert {entry.name for entry in base.iterdir() if entry.is_dir()} == expected
    others = [name for name, stream in session.streams.items() if stream.traits.kind not in folders]
    note = base / "not-exported.txt"
    assert note.exists() == bool(others)
    assert all(name in note.read_text() for name in others)


def test_events_come_back_as_the_text_that_was_written() -> None:
    for text in ("", "lamp on", "Kontakt gelöst: 3 µm"):
        assert event_text(event_row(text)) == text
    with pytest.raises(SessionError, match="allowed: 4 bytes"):
        event_row("fünf", 4)


@pytest.mark.parametrize("key", ["kind", "align", "roles", "clock"])
def test_a_stream_without_a_trait_is_refused(key: str, tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", seconds=0.4, names=("force",))
    edit_json(path / "streams/force/zarr.json", lambda d: d["attributes"].pop(key))
    reseal(path)
    with pytest.raises(SessionError, match=f"force: attribute '{key}' is missing"):
        Session(path)
    assert {finding.code for finding in faults(check(path))} == {"metadata"}


@pytest.mark.parametrize(
    ("attrs", "text"),
    [
        ({"align": "spline"}, "force: found align 'spline'; known: latest"),
        ({"roles": ["signal", "boss"]}, "force: found role"),
        ({"roles": "guard"}, "force: found roles 'guard', expected a list"),
        ({"clock": "sun"}, "force: found clock 'sun'; known: none, monotonic"),
        ({"kind": "Force 1"}, "force: found kind 'Force 1'"),
    ],
)
def test_foreign_traits_are_refused_by_name(
    attrs: dict[str, object], text: str, tmp_path: Path
) -> None:
    path = make_session(tmp_path / "s.zarr", seconds=0.4, names=("force",))
    set_attrs(path / "streams/force", **attrs)
    with pytest.raises(SessionError, match=text):
        Session(path)


@pytest.mark.parametrize(
    ("streams", "text"),
    [
        ([force_spec(1000), force_spec(500)], "stream force: found twice"),
        ([force_spec(1000, name="a b")], "allowed as a name: a letter"),
        ([force_spec(1000, name="../x")], "allowed as a name: a letter"),
        ([depth_spec(30, name="depth")], "stream depth: is the name of a column of frames"),
        (
            [force_spec(9, name="a"), force_spec(9, name="b"), events_spec(name="b_age")],
            "stream b_age: is the name of a column of frames",
        ),
    ],
)
def test_streams_that_would_collide_are_refused(
    streams: list[StreamSpec], text: str, tmp_path: Path
) -> None:
    with pytest.raises(SessionError, match=text):
        SessionWriter.create(tmp_path / "s.zarr", attrs={}, streams=streams, targets={})
    assert list(tmp_path.iterdir()) == []


def test_an_alignment_that_the_values_do_not_allow_is_refused() -> None:
    with pytest.raises(SessionError, match="found align 'mean'; allowed for its columns: n"):
        camera_spec(30, align="mean")
    with pytest.raises(SessionError, match="found align 'interpolated'"):
        events_spec(name="log", align="interpolated")
    with pytest.raises(SessionError, match="found align 'mean'"):
        pose_spec(125, align="mean")  # the mean of rotation vectors is no rotation


def test_a_stream_without_a_role_never_makes_a_row_invalid(tmp_path: Path) -> None:
    streams = [force_spec(1000), camera_spec(60, name="room", height=16, width=24, roles=[])]
    columns = {"force": stream_columns("force", 1, (16, 24), "jpeg", 1)}
    session = Session(record_run(tmp_path / "s.zarr", columns, streams=streams))
    assert session.signal is None
    assert session.frames["valid"].all()
    assert (session.frames["image"] == -1).all()


def test_taxel_arrays_of_any_size_have_a_place(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    spec = taxels_spec(60, taxels=24)
    with SessionWriter.create(path, attrs={}, streams=[spec], targets={}) as session:
        session.begin_run({"t0_ns": T0, "utc": None, "boot_id": "b"})
        columns = stream_columns("taxels", 1, (16, 24), "jpeg", 1)
        columns["value"] = np.tile(columns["value"], (1, 2, 1))[:, :24]
        append_all(path / "streams/taxels", columns)
        blank = {"image": -1, "wrench": np.full(6, np.nan), "wrench_std": np.full(6, np.nan)}
        rest = columns["value"][0].astype(float)
        session.reference.append(point=0, taxels=rest, run=0, t_ns=T0, **blank)
        session.finish("complete", rate_hz=40)
    found = [str(one) for one in faults(check(path)) if one.code != "nan"]
    assert found == []  # forces of a bench without a gauge are NaN
    assert Session(path).frames["taxels"].shape[1:] == (24, 3)
    contact_sheet(path, tmp_path / "sheet.png")


def test_nan_is_a_fault_on_measured_axes_only(tmp_path: Path) -> None:
    columns = stream_columns("force", 1, (16, 24), "jpeg", 1)
    columns["value"][:, [0, 1, 3, 4, 5]] = np.nan
    spec = force_spec(1000, axes_measured=["Fz"])
    path = record_run(tmp_path / "s.zarr", {"force": columns}, streams=[spec])
    assert faults(check(path)) == []
    set_attrs(path / "streams/force", axes_measured=["Fx", "Fz"])
    assert [finding.code for finding in faults(check(path))] == ["nan"]


@pytest.mark.parametrize("name", ["camera", "a_name_with_as_many_letters_as_allowed__"])
def test_columns_of_the_description_stand_below_their_titles(name: str, tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    specs = [camera_spec(30, name=name, height=4, width=4), force_spec(100)]
    with SessionWriter.create(path, attrs={}, streams=specs, targets={}) as session:
        session.finish("complete", rate_hz=30)
    lines = describe(path).splitlines()
    title = next(number for number, line in enumerate(lines) if line.startswith("stream "))
    ends = [match.end() for match in re.finditer(r"rows|Hz|measured|gap ms|lost|MB", lines[title])]
    for line in lines[title + 1 : title + 3]:
        assert [match.end() for match in re.finditer(r"\S+", line)][1:] == ends
