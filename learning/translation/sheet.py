"""A contact sheet of a translated archive: source, translated, the true target, what differs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from learning.errors import LearningError
from recorder import MarkerArchive
from recorder.archive import ArchivedSensor, location_pairs
from recorder.plot import INK, PAPER, SOFT, font
from recorder.spec import PHASES

Masks = NDArray[np.bool_]

TILE, GAP, HEAD, CAPTION = (256, 192), 8, 30, 20
"""Size of a picture, the space around it, the height of what stands above and below [px]."""
FRAMES = 3
"""Presses of a pair that are shown."""
MARKER, GROUND, ONLY_MADE, ONLY_TRUE = (240, 240, 236), (22, 26, 34), (255, 150, 30), (70, 150, 255)
"""Colours of markers and ground, and of what is a marker in the translated frame or the true one
alone."""


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """One row of the sheet."""

    title: str
    source: Masks
    made: Masks
    true: Masks | None
    """What the target really showed at the same place, if it was pressed there."""


def draw_sheet(archive: MarkerArchive, translated: MarkerArchive, out: Path) -> None:
    """Write a PNG: for each pair some presses, evenly over those there are.

    Args:
        archive: What was translated.
        translated: What was made of it.
        out: Where the picture goes.

    Raises:
        LearningError: An archive of something else.
        SessionError: A damaged archive.
        OSError: Not writable.
    """
    rows = [row for sensor in translated.values() for row in _chosen(archive, sensor)]
    height = HEAD + TILE[1] + CAPTION + GAP
    size = GAP + 4 * (TILE[0] + GAP), GAP + len(rows) * height
    page = Image.new("RGB", size, PAPER)
    for place, row in enumerate(rows):
        _draw(page, GAP + place * height, row)
    out.parent.mkdir(parents=True, exist_ok=True)
    page.quantize(64, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)


def dice(one: Masks, other: Masks) -> float:
    """Return 2 |A and B| / (|A| + |B|) of two masks; 1 where both are empty."""
    total = int(np.count_nonzero(one)) + int(np.count_nonzero(other))
    return 2 * int(np.count_nonzero(one & other)) / total if total else 1.0


def _chosen(archive: MarkerArchive, made: ArchivedSensor) -> Iterator[Shown]:
    names = [made.attrs.get(key) for key in ("source", "target")]
    for name in names:
        if name not in archive:
            raise LearningError(
                f"{archive.name}: found no sensor {name!r}, which {made.name} was made from"
            )
    source, target = (archive[str(name)] for name in names)
    rows = np.flatnonzero(made.table["valid"])
    deepest = rows[made.table["depth"][rows] >= np.quantile(made.table["depth"][rows], 0.7)]
    pairs = location_pairs(made.table, target.table)
    paired = np.isin(pairs.source, deepest)
    of = dict(zip(pairs.source[paired].tolist(), pairs.target[paired].tolist(), strict=True))
    pool = np.array(sorted(of)) if of else deepest
    for row in pool[np.linspace(0, len(pool) - 1, min(FRAMES, len(pool))).astype(int)].tolist():
        yield Shown(
            _title(archive, made, row),
            source.masks([_row_of(source, made, row)])[0],
            made.masks([row])[0],
            target.masks([of[row]])[0] if row in of else None,
        )


def _row_of(source: ArchivedSensor, made: ArchivedSensor, row: int) -> int:
    """Return the row of the source that a translated frame was made from."""
    same = np.ones(len(source), np.bool_)
    for name in ("indenter", "target", "location", "frame"):
        same &= source.table[name] == made.table[name][row]
    found = np.flatnonzero(same)
    if not len(found):
        raise LearningError(f"{made.name}: row {row} was made from no frame of {source.name}")
    return int(found[0])


def _title(archive: MarkerArchive, made: ArchivedSensor, row: int) -> str:
    table = made.table
    code = int(table["phase"][row])
    phase = PHASES[code].replace("_", " ") if code >= 0 else "no phase"
    indenter = archive.indenters[int(table["indenter"][row])]
    depth = 1e3 * table["depth"][row]
    return f"{made.name}: {indenter}, target {table['target'][row]}, {phase}, {depth:.2f} mm"


def _draw(page: Image.Image, top: int, row: Shown) -> None:
    pen = ImageDraw.Draw(page)
    pen.text((GAP, top + 4), row.title, INK, font(16))
    tiles = [(_plain(row.source), "source"), (_plain(row.made), "translated")]
    if row.true is not None:
        tiles.append((_plain(row.true), "target, pressed there"))
        said = f"Dice {dice(row.made, row.true):.3f}: orange too much, blue missing"
        tiles.append((_difference(row.made, row.true), said))
    for place, (pixels, caption) in enumerate(tiles):
        left = GAP + place * (TILE[0] + GAP)
        tile = Image.fromarray(pixels).resize(TILE, Image.Resampling.BOX)
        page.paste(tile, (left, top + HEAD))
        pen.text((left, top + HEAD + TILE[1] + 3), caption, SOFT, font(13))


def _plain(mask: Masks) -> NDArray[np.uint8]:
    return np.where(mask[..., None], MARKER, GROUND).astype(np.uint8)


def _difference(made: Masks, true: Masks) -> NDArray[np.uint8]:
    picture = _plain(made & true)
    picture[made & ~true] = ONLY_MADE
    picture[true & ~made] = ONLY_TRUE
    return picture
