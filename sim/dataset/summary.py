"""Summary of an archive: its size, its presses without a solution, its marker check."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from recorder import MarkerArchive
from recorder.archive import ArchivedSensor, marker_flags
from recorder.markers import unpack
from recorder.plot import INK, PAPER, SOFT, font

# Most flagged frames, and most presses without a solution, that are listed one by one.
SHOWN = 5


def summary(
    path: Path, *, check: bool = True, progress: Callable[[float], None] = lambda fraction: None
) -> Iterator[str]:
    """Yield the lines of the summary of a complete archive.

    Args:
        path: Path of the archive.
        check: True to count markers, about a millisecond per image.
        progress: Called with the fraction of the sensors that are counted.
    """
    archive = MarkerArchive(path)
    images = sum(len(sensor) for sensor in archive.values())
    size = sum(sum(each.files.sizes(each.path).values()) for each in archive.values())
    yield f"{path}: {len(archive)} sensors, {images:,} images, {size / 1e6:,.1f} MB"
    yield from _presses(archive)
    if check:
        yield from _flags(archive, images, progress)


def _presses(archive: MarkerArchive) -> Iterator[str]:
    """Yield the presses that needed other settings than requested, and those without a solution."""
    again: dict[str, None] = {}
    lost: dict[str, None] = {}
    for sensor in archive.values():
        missing = {int(row) for row in sensor.table["source"][~sensor.table["valid"]]}
        for number, line in enumerate(sensor.sources):
            made = json.loads(line)
            if "failed" not in made:
                continue
            press = f"{made['indenter']}, target {made['target']} of {sensor.name}"
            if number in missing:
                lost[f"{press}: {made['failed'][-1]}"] = None
            else:
                again[f"{press}: solved with {made.get('again', 'a costlier choice')}"] = None
    yield from _some(f"{len(again)} presses were solved again in another way", list(again))
    yield from _some(f"{len(lost)} presses have no solution, their rows are not valid", list(lost))


def _flags(archive: MarkerArchive, images: int, progress: Callable[[float], None]) -> Iterator[str]:
    flagged: list[str] = []
    counted = 0
    for place, sensor in enumerate(archive.values()):
        found = marker_flags(sensor)
        counted += _counted(sensor)
        flagged += [f"{sensor.name} {flag}" for flag in found]
        progress((place + 1) / len(archive))
    fraction = f", {1e3 * len(flagged) / counted:.2f} in 1,000" if flagged else ""
    yield f"marker count: {len(flagged)} of {counted:,} images flagged{fraction}"
    yield from _some("", flagged)
    if counted < images:
        yield f"  ({images - counted:,} images have no markers to count, or are not valid)"


def _counted(sensor: ArchivedSensor) -> int:
    if sensor.attrs.get("marker_check") is None:
        return 0
    return int(np.count_nonzero(sensor.table["valid"]))


def _some(title: str, lines: list[str]) -> Iterator[str]:
    if not lines:
        return
    if title:
        yield title
    yield from (f"  {line}" for line in lines[:SHOWN])
    if len(lines) > SHOWN:
        yield f"  and {len(lines) - SHOWN} more: `tactile session check`, and `sources`"


# Small multiples: one picture of the deepest state for each sensor and indenter of an archive.

# Size of a picture, and the gap between pictures [px].
TILE, GAP = (144, 108), 6
# Margins for the names [px].
LEFT, TOP = 92, 30
MARKER, GROUND = (240, 240, 236), (22, 26, 34)
COLOURS = 16


def draw_sheet(archive_path: Path, out: Path) -> None:
    """Write a PNG with a row for each sensor or pattern and a column for each indenter.

    Each picture shows the deepest valid frame: of several, the one nearest to the middle, and of
    these the last before the indenter rises.
    """
    archive = MarkerArchive(archive_path)
    shown = {name: _deepest(sensor) for name, sensor in archive.items()}
    codes = sorted({code for rows in shown.values() for code in rows})
    width, height = TILE[0] + GAP, TILE[1] + GAP
    page = Image.new(
        "RGB", (LEFT + len(codes) * width + GAP, TOP + len(shown) * height + GAP), PAPER
    )
    pen = ImageDraw.Draw(page)
    for column, code in enumerate(codes):
        middle = LEFT + column * width + TILE[0] // 2
        pen.text((middle, TOP - 10), archive.indenters[code], INK, font(14), anchor="ms")
    for row, (name, rows) in enumerate(shown.items()):
        top = TOP + row * height
        pen.text((GAP, top + TILE[1] // 2), name, INK, font(14), anchor="lm")
        for column, code in enumerate(codes):
            place = (LEFT + column * width, top)
            if code not in rows:
                pen.text(place, "none", SOFT, font(12))
                continue
            page.paste(_picture(archive[name].packed([rows[code]])), place)
    out.parent.mkdir(parents=True, exist_ok=True)
    page.quantize(COLOURS).save(out, "PNG", optimize=True)


def _deepest(sensor: ArchivedSensor) -> dict[int, int]:
    """Return the row to show of each indenter, by the indenter's code."""
    table = sensor.table
    aside = np.hypot(*table["position"].T)
    # The release comes after the shear; until then a press is deepest.
    going_down = table["phase"] <= 1
    order = np.lexsort((table["frame"], -aside.round(6), table["depth"].round(9)))
    rows = {}
    for row in order:
        if table["valid"][row] and going_down[row]:
            rows[int(table["indenter"][row])] = int(row)
    return rows


def _picture(packed: NDArray[np.uint8]) -> Image.Image:
    (mask,) = unpack(packed)
    pixels = np.where(mask[..., None], MARKER, GROUND).astype(np.uint8)
    return Image.fromarray(pixels).resize(TILE, Image.Resampling.BOX)
