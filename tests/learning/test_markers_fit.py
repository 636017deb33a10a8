"""Marker detection fitted to pictures without contact, on painted ones whose mask is known."""

import contextlib
import functools
import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from learning.errors import LearningError
from learning.markers import Segmenter, read_preset
from learning.markers.fit import as_yaml, fit_preset, recalls
from learning.markers.pattern import in_pattern, pitch_of
from recorder import MarkerArchive
from recorder.markers import find_blobs
from sim.markers.pattern import NAMES, hexagon, named
from tactile.__main__ import main

pytestmark = pytest.mark.slow

SCALE = 2


@functools.cache
def painted(
    seed: int, *, markers: bool = True, pressed: bool = False, bright: bool = False
) -> tuple[Any, Any]:
    """Return a picture (480, 640, 3) under three uneven coloured lamps, and its mask."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[: 480 * SCALE, : 640 * SCALE].astype(np.float32) / SCALE
    lamps = ((100, 240, 2e5), (560, 80, 1.5e5), (400, 460, 2e5))
    light = [80 + 115 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / w) for u, v, w in lamps]
    if pressed:  # a bump, lit and shaded by each lamp, and a shadow of one lamp with a sharp edge
        ring = np.exp(-(((np.hypot(x - 330, y - 250) - 95) / 14) ** 2))
        for lamp, angle in enumerate((0.3, 2.4, 4.5)):
            slope = (np.cos(angle) * (x - 330) + np.sin(angle) * (y - 250)) / 95
            light[lamp] *= 1 + 0.6 * ring * np.clip(slope, -1, 1)
        light[2] *= np.where((x > 500) & (y > 300) & (x - y < 260), 0.6, 1)
    mask = np.zeros(x.shape, bool)
    if markers:
        for row in range(7):
            for column in range(9):
                u, v = 32 + 72 * column, 26 + 72 * row
                u, v = u + random.uniform(-3, 3), v + random.uniform(-3, 3)
                radius = 14 * random.uniform(0.85, 1.1)
                rows = slice(max(int((v - 17) * SCALE), 0), int((v + 17) * SCALE))
                columns = slice(max(int((u - 17) * SCALE), 0), int((u + 17) * SCALE))
                part = rows, columns
                mask[part] |= np.hypot(x[part] - u, y[part] - v) < radius
    picture = np.stack(light, axis=-1)
    ink = 0.3 * picture if not bright else np.full_like(picture, 230.0)
    picture = np.where(mask[..., None], ink, picture if not bright else 0.3 * picture)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.2 * SCALE)
    picture = cv2.resize(picture, (640, 480), interpolation=cv2.INTER_AREA)
    picture += random.normal(0, 2, picture.shape)
    known = cv2.resize(mask.astype(np.float32), (640, 480), interpolation=cv2.INTER_AREA) >= 0.5
    return np.clip(picture, 0, 255).astype(np.uint8), known


def iou(one: Any, other: Any) -> float:
    return float((one & other).sum() / (one | other).sum())


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Folder of a preset that the command fitted to a picture, and what it printed."""
    folder = tmp_path_factory.mktemp("fitted")
    for name, pressed in (("a", False), ("b", True)):
        picture = cv2.cvtColor(painted(0, pressed=pressed)[0], cv2.COLOR_RGB2BGR)
        assert cv2.imwrite(str(folder / f"{name}.png"), picture)
    words = ["markers-fit", str(folder / "a.png"), "--pressed", str(folder / "b.png")]
    words += ["--out", str(folder / "mine.yaml"), "--sheet", str(folder / "sheet.png")]
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main([*words, "--pitch-mm", "1.8"]) == 0
    return folder, printed.getvalue()


@pytest.mark.parametrize("bright", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_fitted_preset_finds_painted_markers_and_finds_them_again_under_a_contact(
    bright: bool, fitted: tuple[Path, str]
) -> None:
    no_contact, mask = painted(0, bright=bright)
    preset = read_preset(fitted[0] / "mine.yaml")
    if bright:
        preset, pattern = fit_preset([no_contact], pitch_mm=1.8)
        assert (pattern.spread.count, pattern.detector.bright) == (63, True)
    assert preset.mm_per_px == pytest.approx(1.8 / 70, rel=0.05)
    pressed, pressed_mask = painted(0, pressed=True, bright=bright)
    assert iou(Segmenter(preset).mask(no_contact), mask) >= 0.98
    assert iou(Segmenter(preset).mask(pressed), pressed_mask) >= 0.98
    (recall,) = recalls(preset, no_contact, [pressed])
    assert recall.under >= (0 if bright else 5)  # on a dark skin the light hardly changes
    assert (recall.under_found, recall.elsewhere_found) == (recall.under, recall.elsewhere)


def test_specks_and_lamps_beside_the_pattern_are_left_out_of_the_region(tmp_path: Path) -> None:
    picture = np.full((480, 640, 3), 30, np.uint8)
    pins = [(round(320 + x), round(240 + y)) for x, y in hexagon(6, 26.0)]
    false = [(60, 60), (90, 60), (120, 60), (600, 240), (570, 440), (30, 300)]
    for place in pins + false:
        cv2.circle(picture, place, 7, (210, 210, 210), -1)
    picture = cv2.GaussianBlur(picture, (5, 5), 0)

    preset, pattern = fit_preset([picture])

    assert pattern.spread.count == len(pins) == 127
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump(as_yaml(preset)))
    assert read_preset(file) == preset
    centres = find_blobs(Segmenter(preset).mask(picture)[None], 12).centre
    away = np.linalg.norm(centres[:, None] - np.array(pins)[None], axis=-1)
    assert len(centres) == 127
    assert away.min(axis=1).max() < 1


@pytest.mark.parametrize("name", NAMES)
def test_every_marker_of_every_pattern_of_the_paper_belongs_to_it(name: str) -> None:
    places = np.asarray(named(name).places)
    count = len(places)
    places = np.concatenate([places, np.add(places.max(axis=0), [[6e-3] * 2, [9e-3] * 2])])
    kept = in_pattern(places, float(np.median(pitch_of(places))))
    assert np.array_equal(np.flatnonzero(kept), np.arange(count))


def test_shading_and_noise_without_markers_are_refused() -> None:
    pictures = [painted(1, markers=False, pressed=pressed)[0] for pressed in (False, True)]
    for picture in pictures:
        with pytest.raises(LearningError, match="no regular pattern of markers"):
            fit_preset([picture])


def test_the_command_writes_a_preset_that_markers_reads(fitted: tuple[Path, str]) -> None:
    folder, printed = fitted
    out = folder / "mine.yaml"
    assert "63 dark markers" in printed
    assert "found under the contact" in printed
    assert f"tactile markers SESSION --preset {out}" in printed
    assert read_preset(out).detectors[0].KIND == "hat"
    assert yaml.safe_load(out.read_text())["kind"] == "camera"
    assert cv2.imread(str(folder / "sheet.png")).shape == (480, 1280, 3)


def test_a_folder_of_pictures_becomes_masks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "mine" / "ball"
    folder.mkdir(parents=True)
    for name, pressed in (("a.png", False), ("b.jpg", True), ("c.png", True)):
        picture = cv2.cvtColor(painted(2, pressed=pressed)[0], cv2.COLOR_RGB2BGR)
        assert cv2.imwrite(str(folder / name), picture)
    out = tmp_path / "x.markers.zarr"
    command = ["markers", str(folder), "--out", str(out), "--preset", "dark-markers"]
    assert main(command) == 2
    assert "--stills if each picture is a contact of its own" in capsys.readouterr().err
    session = tmp_path / "ball.zarr"
    made = ["import", str(folder), "--out", str(session), "--stills", "--yes"]
    made += ["--sensor", "mine", "--indenter", "ball", "--no-contact", "a.png"]
    assert main(made) == 0
    command[1] = str(session)
    assert main([*command, "--mm-per-px", "0.03"]) == 0
    sensor = MarkerArchive(out)["mine"]
    assert len(sensor) == 2
    for mask in sensor.masks([0, 1]):
        assert iou(mask, painted(2, pressed=True)[1]) > 0.85
    assert main(["markers", str(folder / "a.png"), "--out", str(out)]) == 2
    assert "is no session" in capsys.readouterr().err


def test_wrong_files_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "empty").mkdir()
    for path, message in (
        (tmp_path / "text.png", "not a picture"),
        (tmp_path / "none.png", "no such file"),
        (tmp_path / "empty", "found no pictures"),
    ):
        assert main(["markers-fit", str(path)]) == 2
        assert message in capsys.readouterr().err
