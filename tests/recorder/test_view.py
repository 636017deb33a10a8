"""A session in Rerun, read back with Rerun's reader."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.sessions import make_session

from recorder import Session, SessionError
from recorder.convert.rerun_view import view
from tactile.__main__ import main

needs_rerun = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("rerun") is None,
        reason="rerun-sdk is not installed: pip install 'tactile-rig[view]'",
    ),
]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "s.zarr"
    return make_session(path, names=("camera", "force", "pose", "taxels"))


class Rrd:
    """Columns of an .rrd file by entity, as Rerun reads them."""

    def __init__(self, path: Path) -> None:
        from rerun.chunk import RrdReader

        self.batches: dict[str, list[Any]] = {}
        for chunk in RrdReader(path).stream():
            self.batches.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())

    def column(self, entity: str, name: str) -> list[Any]:
        """Return the values of one component, row by row."""
        rows: list[Any] = []
        for batch in self.batches[entity]:
            rows += batch.column(batch.schema.names.index(name)).to_pylist()
        return rows

    def numbers(self, entity: str) -> np.ndarray:
        return np.array([row[0] for row in self.column(entity, "Scalars:scalars")])

    def times(self, entity: str, line: str) -> np.ndarray:
        """Return the times [ns] on a time line."""
        columns = [b.column(b.schema.names.index(line)) for b in self.batches[entity]]
        return np.concatenate([column.cast("int64").to_numpy() for column in columns])


class TestWithRerun:
    pytestmark = needs_rerun

    def test_images_are_the_cameras_bytes_and_series_are_the_streams(
        self, recorded: Path, tmp_path: Path
    ) -> None:
        out = tmp_path / "s.rrd"
        assert main(["session", "view", str(recorded), "--save", str(out)]) == 0
        session, rrd = Session(recorded), Rrd(out)
        camera = session.streams["camera"]
        blobs = rrd.column("/camera", "EncodedImage:blob")
        assert len(blobs) == len(camera)
        for row in (0, 70, len(camera) - 1):
            kind = rrd.column("/camera", "EncodedImage:media_type")[row]
            stored = camera.jpeg(row)
            assert kind == ["image/jpeg"]
            assert bytes(blobs[row][0]) == stored
        force = session.streams["force"].array("value")
        assert np.array_equal(rrd.numbers("/force_N/Fz"), force[:, 2])
        assert np.array_equal(rrd.numbers("/torque_Nm/Tx"), force[:, 3])
        pose = session.streams["pose"].array("value")
        assert np.allclose(rrd.numbers("/position_mm/z"), 1e3 * pose[:, 2])
        taxels = session.streams["taxels"].array("value")
        rows = rrd.column("/taxels_counts/z", "Scalars:scalars")
        assert np.array_equal(np.array(rows), taxels[:, :, 2])

    def test_both_time_lines_are_the_sessions(self, recorded: Path, tmp_path: Path) -> None:
        out = tmp_path / "s.rrd"
        view(recorded, save=out)
        session, rrd = Session(recorded), Rrd(out)
        source = session.sources(0).streams["force"]
        assert source is not None
        began = np.datetime64("2026-01-01T00:00:00", "ns").astype(np.int64)
        utc = source.times - session.runs[0]["t0_ns"] + began
        assert np.array_equal(rrd.times("/force_N/Fx", "capture"), utc)
        relative = rrd.times("/force_N/Fx", "session")
        assert np.array_equal(np.diff(relative), np.diff(utc))
        lines = [rrd.times(entity, "session") for entity in ("/camera", "/force_N/Fx")]
        assert min(times.min() for times in lines) >= 0

    def test_targets_and_phases_are_steps_and_words(self, recorded: Path, tmp_path: Path) -> None:
        out = tmp_path / "s.rrd"
        view(recorded, save=out)
        session, rrd = Session(recorded), Rrd(out)
        targets = np.repeat(np.asarray(session.segments["target"]), 2)
        assert np.array_equal(rrd.numbers("/plan/target"), targets)
        words = [row[0] for row in rrd.column("/plan/log", "TextLog:text")]
        assert len(words) == len(session.segments["target"])
        assert words[1].startswith("target 1: shear_inc, ")

    def test_only_the_part_that_was_asked_for_goes_in(self, recorded: Path, tmp_path: Path) -> None:
        out = tmp_path / "s.rrd"
        told: list[tuple[int, int]] = []
        view(
            recorded,
            save=out,
            start=1.0,
            seconds=0.5,
            progress=lambda done, total: told.append((done, total)),
        )
        rrd = Rrd(out)
        relative = rrd.times("/force_N/Fx", "session")
        assert relative.min() >= 1.0e9
        assert relative.max() < 1.5e9
        assert 490 < len(relative) < 510
        assert told[-1][0] == told[-1][1] > 500

    def test_a_part_without_samples_is_refused_and_leaves_no_file(
        self, recorded: Path, tmp_path: Path
    ) -> None:
        with pytest.raises(SessionError, match="no samples in the requested part"):
            view(recorded, save=tmp_path / "s.rrd", start=1e6)
        assert list(tmp_path.iterdir()) == []


def test_without_rerun_it_says_what_to_install(
    recorded: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["session", "view", str(recorded), "--save", "unused.rrd"]) == 2
    assert "pip install 'tactile-rig[view]'" in capsys.readouterr().err


@pytest.mark.parametrize("part", [("--start", "-1"), ("--seconds", "0"), ("--start", "nan")])
def test_a_part_that_cannot_be_is_refused(
    recorded: Path, part: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["session", "view", str(recorded), "--save", "unused.rrd", *part]) == 2
    assert "allowed" in capsys.readouterr().err
