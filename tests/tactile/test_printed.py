"""Printed lines that no other test compares, and the values that are stored with them."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from recorder import Session
from tactile.run import main

IMPORT = ("--indenter", "ball", "--operator", "me", "--press", "none", "--yes")
NO_PRESS = (
    "Places and depths are unknown: no press can be joined with another sensor's, "
    "but a model of the sensor's own can be trained"
)


def test_pictures_and_forces_are_imported_as_they_are_and_each_rate_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("frames").mkdir()
    pictures = np.arange(12 * 48 * 64 * 3, dtype=np.uint32).reshape(12, 48, 64, 3) % 251
    for number, picture in enumerate(pictures.astype(np.uint8)):
        Image.fromarray(picture).save(f"frames/{number:03}.png")
    forces = np.array([[0, n / 10, -n, 0, 0, 0.01] for n in range(24)])
    rows = "".join(",".join(map(str, row)) + "\n" for row in forces.tolist())
    Path("f.csv").write_text(f"fx,fy,fz,tx,ty,tz\n{rows}")
    words = "--video frames --fps 20 --force f.csv --force-hz 40 --units N --torque-units N*m"
    words += " --trim --sensor gelsight --lag 0"
    assert main(["import", "c.zarr", *words.split(), *IMPORT]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "frames: 20 images/s by --fps, in order of the names, 000.png first, decoded and stored as "
        "pixels, losslessly",
        "f.csv: 40 rows/s by --force-hz",
        "f.csv: rounded to 1e-6 N and 1e-9 N m; largest change 4.4e-16 N, 0 N m",
        "frames: lag of +0.000 s by --lag",
        NO_PRESS,
        "c.zarr.import.html: look at it before you use the data",
        "c.zarr: imported",
        "1 recordings, 0 presses, 1 sessions",
        "next: tactile markers c.zarr --out c.markers.zarr",
    ]
    streams = Session(Path("c.zarr")).streams
    assert np.array_equal(streams["camera"].images(slice(None)), pictures)
    np.testing.assert_allclose(streams["force"].array("value"), forces, rtol=0, atol=1e-15)
    assert set(np.diff(streams["force"].array("t_ns"))) == {25_000_000}
    assert main(["session", "check", "c.zarr"]) == 0
    assert "c.zarr: no faults, " in capsys.readouterr().out


def test_taxels_are_imported_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    counts = np.arange(60 * 48).reshape(60, 48) * 3
    np.save("t.npy", counts)
    words = "--taxels t.npy --taxels-hz 60 --taxel-order taxel --sensor uskin"
    assert main(["import", "b.zarr", *words.split(), *IMPORT]) == 0
    assert capsys.readouterr().out.startswith(f"t.npy: 60 rows/s by --taxels-hz\n{NO_PRESS}\n")
    stored = Session(Path("b.zarr")).streams["taxels"].array("value")
    assert np.array_equal(stored, counts.reshape(60, 16, 3))


def test_a_campaign_lists_its_sessions_with_what_is_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["campaign", "--file", "campaigns/day.yaml", "--out", str(tmp_path), "--list"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert rows[0][:5] == ["sensor", "indenter", "plan", "targets", "state"]
    assert [row[1:5] for row in rows[1:4]] == [
        ["gelsight", "prism", "force_depth", "0/3"],
        ["gelsight", "cylinder", "press_shear", "0/240"],
        ["gelsight", "sphere", "press_shear", "0/240"],
    ]
    assert {row[5] for row in rows[1:9]} == {"open"}
    assert rows[9][:5] == ["0", "of", "8", "sessions", "done,"]
