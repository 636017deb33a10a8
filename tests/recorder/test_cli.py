"""The command line: its output, its exit codes, and the contact sheet."""

from pathlib import Path

import numpy as np
import pytest
import zarr
from PIL import Image
from support.sessions import make_session, reseal

from recorder import SessionError, contact_sheet
from tactile.__main__ import main


def test_info_tells_rows_rates_frames_and_outcomes(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["session", "info", str(recorded)]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line}
    assert lines["camera"].split()[1:4] == ["216", "60", "60.00"]
    assert lines["force"].split()[1:3] == ["3600", "1000"]
    assert "status complete" in lines[str(recorded)]
    assert "complete 8, force_limited 0" in lines["segments"]
    assert "120 at 40 Hz, 120 valid, 60 to 60" in lines["frames"]
    assert lines["frames"].endswith("on each of 2 targets")


def test_info_counts_the_presses_of_a_target_that_was_pressed_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_session(tmp_path / "s.zarr")
    zarr.open_array(path / "frames/run")[60:] = 1
    zarr.open_array(path / "frames/target")[:] = 1
    reseal(path)
    assert main(["session", "info", str(path)]) == 0
    assert "60 to 60 (median 60) on each of 2 presses of 1 targets" in capsys.readouterr().out


def test_check_exits_with_what_it_found(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["session", "check", str(recorded)]) == 0
    assert capsys.readouterr().out.endswith(f"{recorded}: no faults, 3 notes\n")
    path = make_session(tmp_path / "s.zarr")
    (path / "streams/force/seq/c/0").unlink()
    assert main(["session", "check", str(path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "manifest        streams/force/seq/c/0: missing"
    assert lines[1].startswith("missing-chunk   streams/force/seq: 1 found")
    assert main(["session", "check", "--quick", str(path)]) == 1
    assert capsys.readouterr().out.splitlines() == lines[:1]


def test_recover_prints_what_it_brought_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = make_session(tmp_path / "s.zarr", finish=False)
    (path / "streams/force/t_ns/journal-3600").write_bytes(b"torn")
    assert main(["session", "recover", str(path)]) == 0
    out = capsys.readouterr().out
    assert "3600 rows, 0 of them brought back, 4 torn bytes and 0 half rows dropped" in out
    assert out.endswith("recovered, status recovered\n")
    assert main(["session", "recover", str(path)]) == 0
    assert capsys.readouterr().out.endswith("nothing to do, status recovered\n")


@pytest.mark.parametrize("names", [("camera", "force", "pose"), ("taxels", "force"), ("camera",)])
def test_a_sheet_shows_frames_and_curves(names: tuple[str, ...], tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", names=names)
    assert main(["session", "info", str(path), "--picture", str(tmp_path / "s.png")]) == 0
    with Image.open(tmp_path / "s.png") as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert 1500 < pixels.shape[1] <= 1600
    colored = (np.ptp(pixels, axis=2) > 60).mean(axis=1)
    curves, thumbs = colored[-430:], colored[48 : 48 + 186]
    assert ("force" in names) == bool((curves[:220] > 0.002).any())
    assert ("pose" in names) == bool((curves[240:] > 0.002).any())
    assert "taxels" not in names or thumbs.max() > 0.01
    first, second = pixels[90:260, 60:250], pixels[90:260, 60 + 264 : 250 + 264]
    assert np.abs(first - second).max() > 20


def test_a_sheet_needs_frames(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", finish=False, names=("force",))
    with pytest.raises(SessionError, match="has no frames to show"):
        contact_sheet(path, tmp_path / "s.png")
