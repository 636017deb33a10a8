"""Sessions: runs, the frames view, windows, recovery, and compatibility with other readers."""

import itertools
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from support.sessions import (
    CONTACT_FRAME,
    DEPTH,
    T0,
    append_all,
    as_it_is,
    depth_at,
    make_session,
    reseal,
    set_attrs,
    stream_columns,
)

from recorder import (
    FORMAT_VERSION,
    Session,
    SessionError,
    SessionWriter,
    Stream,
    Window,
    camera_spec,
    force_spec,
    recover,
)
from recorder.checks.check import check
from recorder.convert import Options, export
from recorder.findings import faults
from recorder.session.contact_frame import in_frame
from recorder.session.frames import write_frames
from recorder.session.reader import grid
from recorder.store import files
from recorder.store.reader import Table
from tests.support.zarr_readers import READERS, reader_of_zarr


def test_files_are_durable_before_the_manifest_names_them_and_it_before_the_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    orders: dict[tuple[int, int], int] = {}
    fsync, numbers = os.fsync, itertools.count()

    def noted(fd: int) -> None:
        fsync(fd)
        found = os.fstat(fd)
        orders[found.st_ino, found.st_mtime_ns] = next(numbers)

    monkeypatch.setattr(os, "fsync", noted)
    path = make_session(tmp_path / "s.zarr", change=as_it_is)

    def order(entry: Path) -> float:
        """Return when the present content of a file or directory was made durable."""
        found = entry.stat()
        return orders.get((found.st_ino, found.st_mtime_ns), np.inf)

    manifest, status = path / "manifest/0/zarr.json", path / "zarr.json"
    later = {path / "manifest/0", manifest, status}
    late = [
        str(entry.relative_to(path))
        for entry in path.rglob("*")
        if entry not in later and order(entry) >= order(manifest)
    ]
    assert late == []
    assert order(manifest) < order(status) < np.inf


def tree(path: Path) -> dict[str, bytes]:
    """Return all files below a directory."""
    return {str(f.relative_to(path)): f.read_bytes() for f in path.rglob("*") if f.is_file()}


def test_a_session_holds_what_was_appended(recorded: Path) -> None:
    session = Session(recorded)
    for name, stream in session.streams.items():
        for column, values in stream_columns(name, 3.6, (48, 64), "jpeg", seed=1).items():
            if (name, column) == ("camera", "value"):
                assert [stream.jpeg(row) for row in range(len(stream))] == values
            else:
                np.testing.assert_array_equal(stream.array(column), values)
    assert session.status == "complete"
    assert session.attrs["format_version"] == FORMAT_VERSION
    assert session.runs[0]["first_row"] == {
        "camera": 0, "force": 0, "pose": 0, "segments": 0, "reference": 0
    }  # fmt: skip


def test_create_refuses_an_existing_path_and_leaves_nothing_of_a_bad_one(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(SessionError, match="exists already"):
        SessionWriter.create(tmp_path / "there", attrs={}, streams=[], targets={})
    with pytest.raises(SessionError, match="not storable"):
        SessionWriter.create(tmp_path / "bad", attrs={"x": object()}, streams=[], targets={})
    uneven = {"a": np.zeros(1), "b": np.zeros(2)}
    with pytest.raises(SessionError, match="unequal length"):
        SessionWriter.create(tmp_path / "bad", attrs={}, streams=[], targets=uneven)
    assert [entry.name for entry in tmp_path.iterdir()] == ["there"]


@pytest.mark.parametrize(
    ("version", "text"),
    [
        (1, "found format_version 1, this program reads 2$"),
        (3, "found format_version 3, this program reads 2; update it"),
    ],
)
def test_another_version_is_refused_in_a_clear_sentence(
    version: int, text: str, tmp_path: Path
) -> None:
    path = make_session(tmp_path / "s.zarr")
    set_attrs(path, format_version=version)
    with pytest.raises(SessionError, match=text):
        Session(path)


def test_every_array_says_its_units_and_dimensions(recorded: Path) -> None:
    arrays = [d for f in recorded.rglob("zarr.json")
              if (d := json.loads(f.read_text()))["node_type"] == "array"]  # fmt: skip
    assert len(arrays) > 30
    for array in arrays:
        assert array["attributes"]["units"]
        assert array["attributes"]["description"]
        assert len(array["dimension_names"]) == len(array["shape"])


def test_ticks_fall_on_one_grid_and_inside_the_phases(recorded: Path) -> None:
    session = Session(recorded)
    frames, segments = session.frames, session.segments
    anchor = int(segments["start_ns"][0])
    steps = (frames["t_ns"] - anchor) * 40
    assert (np.abs(steps - np.round(steps / 1e9) * 1e9) <= 40).all()
    inside = 0
    for row in range(len(segments["target"])):
        start, end = segments["start_ns"][row], segments["end_ns"][row]
        here = (frames["t_ns"] >= start) & (frames["t_ns"] < end)
        assert (frames["target"][here] == segments["target"][row]).all()
        assert (frames["phase"][here] == segments["phase"][row]).all()
        assert abs(here.sum() - (end - start) * 40e-9) <= 1
        inside += here.sum()
    assert inside == len(frames["t_ns"])


@pytest.mark.parametrize("rate_hz", [40, 60, 59.94])
def test_a_grid_has_no_hole_and_no_double_tick(rate_hz: float) -> None:
    whole = grid(T0, T0, T0 + 10**10, rate_hz)
    parts = [grid(T0, T0 + k * 333_333_333, T0 + (k + 1) * 333_333_333, rate_hz) for k in range(30)]
    joined = np.concatenate(parts)
    np.testing.assert_array_equal(joined, whole[: len(joined)])
    assert abs(len(whole) - 10 * rate_hz) <= 1


def test_every_label_belongs_to_its_image_and_not_to_its_tick(recorded: Path) -> None:
    session = Session(recorded)
    frames, camera, force = session.frames, session.streams["camera"], session.streams["force"]
    point = session.targets["point"][frames["target"]]
    for row in range(0, len(frames["t_ns"]), 7):
        image, tick = int(frames["image"][row]), int(frames["t_ns"][row])
        capture = int(camera.t_ns[image])
        assert capture <= tick < camera.t_ns[image + 1]
        assert frames["image_age"][row] == pytest.approx((tick - capture) * 1e-9)
        lit = (force.t_ns >= capture - 10_000_000) & (force.t_ns <= capture)
        offset = np.repeat([0.25 if point[row] == 0 else 0.0, 0.0], 3)
        expected = force.array("value")[lit].mean(axis=0) - offset
        np.testing.assert_allclose(frames["wrench"][row], expected, atol=1e-12)
        depth = depth_at(np.array([(capture - T0) * 1e-9]))[0]
        assert frames["depth"][row] == pytest.approx(depth, abs=DEPTH / 50)
        assert frames["skew"][row] < 0.005
    same = frames["image"][1:] == frames["image"][:-1]
    np.testing.assert_array_equal(frames["is_duplicate"][1:], same)


def test_without_a_camera_the_taxels_are_the_signal(tmp_path: Path) -> None:
    session = Session(make_session(tmp_path / "s.zarr", names=("taxels", "force", "pose")))
    taxels, frames = session.streams["taxels"], session.frames
    row = int(np.searchsorted(taxels.t_ns, frames["t_ns"][10], side="right")) - 1
    np.testing.assert_array_equal(frames["taxels"][10], taxels.array("value")[row])
    assert frames["image_age"][10] == pytest.approx((frames["t_ns"][10] - taxels.t_ns[row]) * 1e-9)
    assert (frames["image"] == -1).all()


@pytest.mark.parametrize("attrs", [{"latency": 0.02}, {"clock": "monotonic"}])
def test_latency_and_the_cameras_own_clock_move_the_capture(
    attrs: dict[str, Any], tmp_path: Path
) -> None:
    path = make_session(tmp_path / "s.zarr")
    set_attrs(path / "streams/camera", **attrs)
    session = Session(path)
    camera, source = session.streams["camera"], session.sources(0).streams["camera"]
    assert source is not None
    if "latency" in attrs:
        np.testing.assert_array_equal(source.times, camera.t_ns - 20_000_000)
        write_frames(path, 40)
        reseal(path)
        frames = Session(path).frames
        age = (frames["t_ns"] - camera.t_ns[frames["image"]] + 20_000_000) * 1e-9
        np.testing.assert_allclose(frames["image_age"], age)
        assert frames["image_age"].max() < 0.018
    else:
        np.testing.assert_array_equal(source.times, np.round(camera.array("device_t") * 1e9))


def rows_of(window: Window) -> np.ndarray[Any, Any]:
    """Return the rows of the first camera in a window."""
    row = window.streams["camera"].row
    assert row is not None
    return row


def test_a_window_holds_images_labels_ages_and_never_clips(recorded: Path) -> None:
    session = Session(recorded)
    end = T0 + 2_000_000_000
    window = session.window(end, 16, rate_hz=60)
    camera = session.streams["camera"]
    assert window.image is not None
    np.testing.assert_array_equal(window.image, camera.images(rows_of(window)))
    assert window.t_ns[-1] == end
    assert window.valid.all()
    np.testing.assert_allclose(np.diff(window.t_ns), 1e9 / 60, atol=1)
    early = session.window(T0 + 50_000_000, 8, rate_hz=60)
    assert len(early.t_ns) == 8
    assert early.image is not None
    missing = rows_of(early) < 0
    assert missing.sum() >= 4
    assert not early.valid[missing].any()
    assert early.image[missing].max() == 0
    assert early.taxels is None
    last = len(session.frames["t_ns"]) - 1
    by_row = [session.window(row=row, n=16).wrench for row in (last, -1)]
    for rows in by_row:
        np.testing.assert_array_equal(
            rows, session.window(int(session.frames["t_ns"][last]), 16).wrench
        )


def test_a_row_is_never_taken_for_a_time(recorded: Path) -> None:
    session = Session(recorded)
    for time in (100, T0 + 10**11):
        with pytest.raises(SessionError, match=rf"t_ns: found {time}; run 0 has samples from \d"):
            session.window(time, 16)
    with pytest.raises(IndexError, match="10000 is out of bounds"):
        session.window(row=10000)
    for given in ({}, {"t_ns": T0, "row": 3}):
        with pytest.raises(SessionError, match="allowed: one of them"):
            session.window(**given)
    with pytest.raises(TypeError, match="integer"):
        session.window(row=3, n=2.5)  # type: ignore[arg-type]


def test_a_window_of_any_method_stays_near_its_samples(recorded: Path) -> None:
    session = Session(recorded)
    for force in ("mean", "interpolated", "latest", "nearest"):
        for image in ("latest", "nearest"):
            align = {"force": force, "pose": "nearest", "camera": image}
            window = session.window(T0 + 10**9, 5, align=align)
            assert window.valid.all()
            assert np.abs(window.streams["force"].age).max() < 0.002
    with pytest.raises(
        SessionError, match="found method 'cubic'; known: latest, nearest, interpolated, mean"
    ):
        session.window(T0, 1, align={"force": "cubic"})


def test_runs_keep_apart_even_if_the_clock_starts_anew(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("camera", "force"))
    lengths = {name: len(stream) for name, stream in Session(path).streams.items()}
    with SessionWriter.resume(path) as again:
        assert Session(path).status == "recording"
        again.begin_run({"t0_ns": 5})
        for name in ("camera", "force"):
            columns = stream_columns(name, 2.0, (48, 64), "jpeg", seed=2)
            columns["t_ns"] = columns["t_ns"] - T0 + 5_000_000_000  # after a restart
            append_all(again.stream_path(name), columns)
        times = {"start_ns": 5_200_000_000, "end_ns": 6_000_000_000}
        again.segments.append(target=3, phase=0, outcome=0, run=1, **times)
        again.finish("stopped", "enough", rate_hz=40)
    assert faults(check(path)) == []
    session = Session(path)
    assert (session.status, session.attrs["reason"]) == ("stopped", "enough")
    assert session.runs[1]["first_row"]["camera"] == lengths["camera"]
    second = session.frames["run"] == 1
    assert second.sum() == 32
    assert (session.frames["image"][second] >= lengths["camera"]).all()
    assert (session.frames["image"][~second] < lengths["camera"]).all()
    assert session.window(5_500_000_000, 3).valid.all()
    at_start = session.window(5_030_000_000, 6)
    assert set(rows_of(at_start)) <= {-1, *range(lengths["camera"], lengths["camera"] + 3)}


def test_a_session_still_recording_opens_and_says_so(tmp_path: Path) -> None:
    session = Session(make_session(tmp_path / "s.zarr", finish=False))
    assert session.warning is not None
    assert "still recording" in session.warning
    assert len(session.streams["force"]) == 3600
    assert len(session.frames) == 0


def test_recovery_closes_a_killed_session_once_and_for_all(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", finish=False)
    (path / "frames.building").mkdir()
    first = recover(path)
    assert (first.status, first.frames_rebuilt) == ("recovered", True)
    assert faults(check(path)) == []
    before = tree(path)
    assert not recover(path).touched
    assert tree(path) == before


def test_recovery_keeps_the_status_of_a_finished_session(recorded: Path, tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr")
    shutil.rmtree(path / "frames")
    (path / "frames.old").mkdir()
    assert recover(path).status == "complete"
    assert {name: data for name, data in tree(path).items() if name.startswith("frames/")} == {
        name: data for name, data in tree(recorded).items() if name.startswith("frames/")
    }


def test_dying_while_frames_are_built_leaves_the_old_ones_or_none(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = {name: values.copy() for name, values in Session(recorded).frames.items()}
    for fatal in range(1, 4):
        path = tmp_path / f"{fatal}.zarr"
        shutil.copytree(recorded, path)
        left = [fatal]

        def dying(self: Path, target: Any, real: Any = Path.rename, left: Any = left) -> Any:
            left[0] -= 1
            if left[0] <= 0:
                raise KeyboardInterrupt
            return real(self, target)

        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):  # noqa: PT012
            patch.setattr(Path, "rename", dying)
            write_frames(path, 40)
            raise KeyboardInterrupt
        frames = Table(path / "frames")
        assert not frames or all((frames[n] == whole[n]).all() for n in ("t_ns", "image"))
        if not frames:
            with pytest.raises(SessionError, match="missing; the manifest of run 0 names it"):
                Session(path)
        recover(path)
        assert check(path, quick=True) == []
        np.testing.assert_array_equal(Session(path).frames["t_ns"], whole["t_ns"])


def test_recovery_refuses_a_session_that_is_being_written(tmp_path: Path) -> None:
    path, streams = tmp_path / "s", [force_spec(1000)]
    writer = SessionWriter.create(path, attrs={}, streams=streams, targets={})
    with writer, pytest.raises(SessionError, match="being written"):
        recover(path)


def test_finish_recovers_a_stream_whose_process_died(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", finish=False)
    camera = path / "streams/camera"
    (camera / "value/c/9/0/0").mkdir(parents=True)
    (camera / "t_ns/journal-216").write_bytes(b"TRL1 torn")
    with SessionWriter.resume(path) as session:
        session.finish("complete", rate_hz=40)
    assert faults(check(path)) == []
    assert len(Session(path).streams["camera"]) == 216


def test_unknown_streams_and_statuses_are_refused_by_name(tmp_path: Path) -> None:
    specs = [force_spec(1000), camera_spec(60, height=4, width=4)]
    with SessionWriter.create(tmp_path / "s", attrs={}, streams=specs, targets={}) as session:
        with pytest.raises(SessionError, match="no stream 'taxels'; known: camera, force"):
            session.stream_path("taxels")
        with pytest.raises(SessionError, match="'done', expected one of complete, stopped"):
            session.finish("done", rate_hz=40)


def test_zarr_python_reads_camera_bytes_through_the_registered_codec(recorded: Path) -> None:
    array = zarr.open_group(recorded, mode="r")["streams/camera/value"]
    images = Stream(recorded / "streams/camera").images([0, 65, 215])
    for row, image in zip((0, 65, 215), images, strict=True):
        np.testing.assert_array_equal(np.asarray(array[row]), image)


def portable(session: Path, copy: Path) -> None:
    export(session, copy, "zarr", options=Options(images="pixels"))


@pytest.mark.slow
def test_a_portable_copy_holds_the_same_pixels_of_all_cameras_for_everybody(tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    cameras = ("camera", "camera_2", "depth_1")
    recorded = make_session(tmp_path / "s.zarr", names=(*cameras, "force", "pose"), seconds=1.0)
    path, pixels_of = tmp_path / "portable.zarr", Options(images="pixels")
    export(recorded, path, "zarr", options=pixels_of, progress=lambda *state: done.append(state))
    assert done[-1][0] == done[-1][1] > 60
    assert faults(check(path)) == []
    source, copy = Session(recorded), Session(path)
    for name in cameras:
        pixels, stored = source.streams[name].images(slice(None)), copy.streams[name]
        assert pixels.dtype == (np.uint16 if name == "depth_1" else np.uint8)
        np.testing.assert_array_equal(stored.images(slice(None)), pixels)
        np.testing.assert_array_equal(zarr.open_array(path / f"streams/{name}/value")[:], pixels)
    assert copy.streams["camera"].jpeg(0) is None
    for name in source.frames:
        np.testing.assert_array_equal(source.frames[name], copy.frames[name])


def test_a_copy_keeps_the_bytes_of_images_as_stored(recorded: Path, tmp_path: Path) -> None:
    export(recorded, tmp_path / "same.zarr", "zarr")
    same, source = (
        Stream(tmp_path / "same.zarr/streams/camera"),
        Stream(recorded / "streams/camera"),
    )
    assert [same.jpeg(row) for row in range(216)] == [source.jpeg(row) for row in range(216)]
    portable(recorded, tmp_path / "portable.zarr")
    export(tmp_path / "portable.zarr", tmp_path / "again.zarr", "zarr")
    copies = [Stream(tmp_path / f"{name}.zarr/streams/camera") for name in ("portable", "again")]
    np.testing.assert_array_equal(*(stream.images(range(216)) for stream in copies))
    profiles = {e.name: Session(e).attrs["profile"] for e in tmp_path.iterdir()}
    known = {"same.zarr": "camera", "portable.zarr": "portable", "again.zarr": "portable"}
    assert profiles == known
    with pytest.raises(SessionError, match="exists already"):
        export(recorded, tmp_path / "portable.zarr", "zarr")


def test_imagecodecs_reads_camera_bytes_under_the_same_name(recorded: Path) -> None:
    other = pytest.importorskip("imagecodecs.zarr", reason="needs imagecodecs on Python 3.12")
    name = f"{other.Jpeg.__module__}.{other.Jpeg.__qualname__}"
    zarr.registry.register_codec("imagecodecs_jpeg", other.Jpeg)
    with zarr.config.set({"codecs.imagecodecs_jpeg": name}):
        found = np.asarray(zarr.open_array(recorded / "streams/camera/value", mode="r")[:3])
    ours = Stream(recorded / "streams/camera").images(range(3))
    assert np.abs(found.astype(int) - ours).max() <= 1  # JPEG libraries round differently


@pytest.mark.parametrize("reader", READERS)
def test_other_readers_read_the_numbers_and_the_portable_images(
    reader: str, recorded: Path, tmp_path: Path
) -> None:
    read, session = reader_of_zarr(reader), Session(recorded)
    portable(recorded, tmp_path / "p.zarr")
    for name, stream in session.streams.items():
        for column in stream.small:
            found = read(recorded / "streams" / name / column)
            np.testing.assert_array_equal(found, stream.array(column))
    for name in ("t_ns", "wrench", "valid"):
        np.testing.assert_array_equal(read(recorded / "frames" / name), session.frames[name])
    pixels = session.streams["camera"].images(range(216))
    np.testing.assert_array_equal(read(tmp_path / "p.zarr/streams/camera/value"), pixels)


def test_places_in_a_contact_frame_are_along_its_axes() -> None:
    frame = np.array([*CONTACT_FRAME[:3], np.pi, 0, 0])  # z points down
    above = np.array([[*CONTACT_FRAME[:2], CONTACT_FRAME[2] - 0.001, 0, 0, 0]])
    assert in_frame(frame, above)[0] == pytest.approx([0, 0, 0.001])
    tilted = np.array([0, 0, 0, 0, np.pi / 2, 0])  # z points along x
    there = in_frame(tilted, np.array([[-0.002, 5, 7, 0, 0, 0]]))[0]
    assert there == pytest.approx([-7, 5, -0.002])


def test_a_session_and_a_stream_say_what_they_are(tmp_path: Path) -> None:
    session = Session(make_session(tmp_path / "s.zarr", seconds=1.0))
    text = repr(session)
    assert "s.zarr" in text
    assert session.status in text
    for name, stream in session.streams.items():
        assert f"{name} {len(stream):,}" in text
        assert repr(stream).startswith(f"<Stream {name}: {len(stream):,} rows of ")


def test_a_contact_sheet_counts_targets_from_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Like the log and the monitoring page, whose target 1 is the first row of `targets`."""
    from PIL import ImageDraw

    from recorder import contact_sheet

    path = make_session(tmp_path / "s.zarr", seconds=0.7)
    drawn: list[str] = []
    whole = ImageDraw.ImageDraw.text

    def text(self: Any, place: Any, words: str, *fill: Any, **style: Any) -> None:
        drawn.append(words)
        whole(self, place, words, *fill, **style)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", text)
    monkeypatch.setattr("recorder.session.sheet.PICTURES", 200)
    contact_sheet(path, tmp_path / "s.png")
    numbers = {int(words.split()[1]) for words in drawn if words.startswith("target ")}
    targets = np.asarray(Session(path).frames["target"])
    assert numbers == set((np.unique(targets[targets >= 0]) + 1).tolist())
    assert min(numbers) == 1


def test_a_session_is_created_and_sealed_with_few_flushes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flushed: list[int] = []
    monkeypatch.setattr(os, "fsync", flushed.append)
    monkeypatch.setattr(files, "SYNCFS", lambda fd: flushed.append(fd) or 0)
    path = make_session(tmp_path / "s.zarr", seconds=0.5, finish=False, change=as_it_is)
    created = len(flushed)
    assert created < 120  # three streams were closed as well
    SessionWriter(path).finish("complete", rate_hz=40)
    assert len(flushed) - created < 40


def test_a_session_has_a_printable_name(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match=r"a.nb.*allowed as a name"):
        SessionWriter.create(tmp_path / "a\nb.zarr", attrs={}, streams=[], targets={})
    assert not list(tmp_path.iterdir())
