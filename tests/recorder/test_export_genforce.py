"""GenForce folders, read as the published scripts do: by folder, file name and column."""

import csv
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from support.sessions import make_session

from recorder import PHASES, Session, SessionError
from recorder.convert import export
from recorder.store.reader import Table

FORCE = ["Fx(N)", "Fy(N)", "Fz(N)", "Tx(Nmm)", "Ty(Nmm)", "Tz(Nmm)"]
POSE = ["X(m)", "Y(m)", "Z(m)", "RX(rad)", "RY(rad)", "RZ(rad)"]


def table(path: Path, names: list[str]) -> np.ndarray:
    """Read a csv by the names of its columns."""
    with path.open(newline="") as file:
        return np.array([[float(row[name]) for name in names] for row in csv.DictReader(file)])


def run_of(path: Path, sensor: str, modality: str) -> Path:
    """Return the only run folder, <indenter>-<YYYYmmdd_HHMMSS>."""
    (run,) = (path / sensor / modality).glob("*-[0-9]*_[0-9]*")
    return run


def points(run: Path) -> list[Path]:
    return sorted((p for p in run.iterdir() if p.is_dir()), key=lambda p: int(p.name))


def exported_phases(run: Path, frames: Table) -> Iterator[tuple[Path, np.ndarray]]:
    """Yield the folder of each phase of each point below a run, and its rows of `frames`."""
    for point in points(run):
        here = frames["target"] == int(point.name) - 1
        for code, phase in enumerate(PHASES):
            yield Path(point.name) / phase, np.flatnonzero(here & (frames["phase"] == code))


def test_camera_runs_have_four_phases_a_point_with_images_forces_and_poses(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr")
    export(path, tmp_path / "data", "genforce")
    session = Session(path)
    frames, camera = session.frames, session.streams["camera"]
    runs = {kind: run_of(tmp_path / "data", "wedge", kind) for kind in ("force", "pose", "image")}
    assert {run.name for run in runs.values()} == {"sphere-20260101_000000"}
    assert (runs["image"] / "ref.jpg").read_bytes() == camera.jpeg(0)
    seen = 0
    assert [point.name for point in points(runs["force"])] == ["1", "2"]
    assert {len([*point.iterdir()]) for point in points(runs["force"])} == {len(PHASES)}
    for place, rows in exported_phases(runs["force"], frames):
        forces = table(runs["force"] / place / "ft.csv", FORCE)
        np.testing.assert_array_equal(forces[:, :3], frames["wrench"][rows, :3])
        np.testing.assert_allclose(forces[:, 3:] / 1e3, frames["wrench"][rows, 3:], rtol=1e-14)
        poses = table(runs["pose"] / place / "pose.csv", POSE)
        np.testing.assert_array_equal(poses, frames["pose"][rows])
        pictures = sorted((runs["image"] / place).glob("*.jpg"))
        assert [p.name for p in pictures] == [f"{k:04d}.jpg" for k in range(len(rows))]
        expected = list(camera.jpegs(frames["image"][rows].tolist()))
        assert [p.read_bytes() for p in pictures] == expected
        seen += len(rows)
    assert seen == len(frames["t_ns"])
    (planned,) = run_of(tmp_path / "data", "wedge", "path").glob("*.csv")
    assert np.loadtxt(planned, delimiter=",").shape == (2, 6)


def test_uskin_runs_hold_counts_less_the_reference(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("taxels", "force", "pose"))
    export(path, tmp_path / "data", "genforce")
    frames = Session(path).frames
    run = run_of(tmp_path / "data", "wedge", "uskin_raw")
    reference = np.load(run / "ref.npy")
    np.testing.assert_array_equal(reference, np.full((16, 3), 30_000))
    rows = np.flatnonzero((frames["target"] == 1) & (frames["phase"] == 1))
    found = [np.load(file) for file in sorted((run / "2" / "shear_inc").glob("*.npy"))]
    assert all(counts.shape == (16, 3) and counts.dtype.kind == "i" for counts in found)
    np.testing.assert_array_equal(np.array(found) + reference, np.rint(frames["taxels"][rows]))
    assert not (tmp_path / "data" / "wedge" / "image").exists()


def test_pixels_become_jpegs_near_them(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=("camera", "force"), codec="zstd", seconds=2.0)
    export(path, tmp_path / "data", "genforce")
    session = Session(path)
    first = run_of(tmp_path / "data", "wedge", "image") / "1" / "normal_inc" / "0000.jpg"
    with Image.open(io.BytesIO(first.read_bytes())) as image:
        found = np.asarray(image).astype(int)
    expected = session.streams["camera"].images([int(session.frames["image"][0])])[0]
    assert np.abs(found - expected).max() <= 4
    assert not (tmp_path / "data" / "wedge" / "pose").exists()


def test_a_press_that_was_cut_short_is_no_point(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", seconds=2.6)  # one press and half of another
    export(path, tmp_path / "data", "genforce")
    assert [p.name for p in points(run_of(tmp_path / "data", "wedge", "force"))] == ["1"]
    short = make_session(tmp_path / "t.zarr", seconds=1.2)
    with pytest.raises(SessionError, match="no press has all of normal_inc"):
        export(short, tmp_path / "other", "genforce")


def test_rows_in_which_a_stream_has_no_value_are_left_out_of_all_and_counted(
    tmp_path: Path,
) -> None:
    def late(name: str, columns: dict[str, Any]) -> dict[str, Any]:
        if name != "taxels":
            return columns
        kept = columns["t_ns"] > columns["t_ns"][0] + 300_000_000
        return {key: values[kept] for key, values in columns.items()}

    names = ("camera", "force", "pose", "taxels")
    path = make_session(tmp_path / "s.zarr", names=names, change=late)
    frames = Session(path).frames
    unknown = np.isnan(frames["taxels"]).any(axis=(1, 2))
    assert 3 < unknown.sum() < len(unknown) / 4
    export(path, tmp_path / "data", "genforce")
    runs = {
        kind: run_of(tmp_path / "data", "wedge", kind) for kind in ("force", "image", "uskin_raw")
    }
    seen = 0
    for place, whole in exported_phases(runs["force"], frames):
        rows = whole[~unknown[whole]]
        forces = table(runs["force"] / place / "ft.csv", FORCE)
        np.testing.assert_array_equal(forces[:, :3], frames["wrench"][rows, :3])
        assert len(list((runs["image"] / place).glob("*.jpg"))) == len(rows)
        counts = [np.load(file) for file in sorted((runs["uskin_raw"] / place).glob("*.npy"))]
        expected = np.rint(frames["taxels"][rows] - 30_000)
        np.testing.assert_array_equal(np.array(counts), expected)
        seen += len(rows)
    assert seen == (~unknown).sum()
    told = (tmp_path / "data" / "wedge" / "not-exported.txt").read_text()
    assert told == f"Rows in which a stream has no sample near enough: {unknown.sum()}\n"
