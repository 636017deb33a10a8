"""Translated archives: the frames of a sensor as others would have shown them, labels and all.

The sensor `A-to-B` has the frames of A translated, the references and the scale of B, and the table
of A: what was pressed where, and how hard. Frames are translated press by press, each whole, so
that markers can be followed; a run that was stopped goes on where it was.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from learning.archive_writer import CHUNK_ROWS, UNIT_ROWS, Frames, archive_fingerprint, fill_archive
from learning.errors import LearningError
from learning.training.checkpoint import read_model_folder
from learning.translation.translator import FLOW, SensorView, Translator, aimed
from recorder import MarkerArchive
from recorder.archive import GIVEN, ArchivedSensor, MarkerCount, SensorPlan, location_pairs
from recorder.markers import PACKED, pack, unpack
from recorder.plot import INK, PAPER, SOFT, font
from recorder.spec import PHASES

if TYPE_CHECKING:
    from learning.data.splits import Role, Split


Rows = NDArray[np.int64]

# What is said of a sensor that is true of its translated frames as well.
_OF_TARGET = ("pattern", "camera", "preset", "sensor")


@dataclass(frozen=True, slots=True)
class Pair:
    """From which sensor to which."""

    source: str
    """Whose frames are translated."""
    target: str
    """What they are translated to."""

    @property
    def name(self) -> str:
        """Name of the translated sensor."""
        return f"{self.source}-to-{self.target}"


@dataclass(frozen=True, slots=True)
class Model:
    """A translator, and what is written down of it."""

    translator: Translator
    """The translator itself, not yet aimed at a pair."""
    name: str
    """`flow`, or the name of the folder it was loaded from."""
    sha256: str
    """Of its weights; of its name, where it has none."""
    device: str = "cpu"
    """Where frames are to be when it gets them."""


def hash_of(name_or_folder: str | Path) -> str:
    """Return the SHA-256 of the weights of a model; of its name, where it has no folder.

    Raises:
        LearningError: A folder without weights.
    """
    if str(name_or_folder) == FLOW:
        return hashlib.sha256(FLOW.encode()).hexdigest()
    return read_model_folder(Path(name_or_folder)).hash()


def translate_archive(
    archive: MarkerArchive,
    out: Path,
    pairs: Sequence[Pair],
    model: Model,
    *,
    split: Split | None = None,
    roles: Sequence[Role] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Make the translated archive of some pairs, or go on with it; return the frames made now.

    Args:
        archive: Whose sensors are translated.
        out: Where the translated archive is, or is to be.
        pairs: From which sensors to which.
        model: What translates.
        split: With `roles`, only these parts are translated.
        roles: Names of roles of the split.
        progress: Called with the frames that are there and those there will be.

    Raises:
        LearningError: Sensors or references that are not there, or a part without frames.
        SessionError: A damaged archive, or another one at `out`.
        OSError: The disk is full, or not writable.
    """
    if archive.warning is not None:
        raise LearningError(archive.warning)
    attrs: dict[str, Any] = {
        "made_by": "learning translate",
        "made_from": archive.path.name,
        "made_from_sha256": archive_fingerprint(archive),
    }
    if split is not None:
        split.check(archive)
        attrs["split"] = split.fingerprint
        attrs["roles"] = sorted(roles)
    sensors = [
        TranslatedSensor(archive, pair, model, _rows_of(archive, pair, split, roles))
        for pair in pairs
    ]
    return fill_archive(out, sensors, archive.indenters, attrs, progress)


class TranslatedSensor:
    """Frames of one sensor, made into those of another when they are asked for."""

    def __init__(self, archive: MarkerArchive, pair: Pair, model: Model, rows: Rows) -> None:
        """Look at both sensors; translate nothing yet.

        Args:
            archive: That has them.
            pair: Which two.
            model: What translates.
            rows: Of the source, that are wanted.

        Raises:
            LearningError: A sensor that is not there, or a reference without markers.
            SessionError: A damaged archive.
        """
        self._source, self._target = _sensor(archive, pair.source), _sensor(archive, pair.target)
        self._table = self._source.table
        self._presses = _press_of(self._table)
        self._rows = _by_press(self._table, rows)
        self._reference = target_references(self._table["location"], self._target.table)
        source, target = SensorView.of(self._source), SensorView.of(self._target)
        self._translator = aimed(model.translator, source, target)
        self._device = model.device
        self._made: tuple[tuple[int, ...], Rows, NDArray[np.uint8]] | None = None
        self.plan = SensorPlan(
            name=pair.name,
            rows=len(self._rows),
            chunk_rows=CHUNK_ROWS,
            unit_rows=UNIT_ROWS,
            references=self._target.references,
            mm_per_px=self._target.mm_per_px,
            marker_count=_marker_count(self._target),
            attrs={
                **{key: self._target.attrs[key] for key in _OF_TARGET if key in self._target.attrs},
                "source": pair.source,
                "target": pair.target,
                "model": model.name,
                "model_sha256": model.sha256,
            },
        )

    def read(self, rows: slice) -> Frames:
        """Translate some of its frames.

        Raises:
            LearningError: The translator cannot.
            SessionError: A chunk of the archive is missing or damaged.
        """
        wanted = self._rows[rows]
        packed = np.zeros((len(wanted), PACKED), np.uint8)
        presses = self._presses[wanted]
        for press in _in_order(presses):
            here = np.flatnonzero((presses == press).all(axis=1))
            here = here[self._table["valid"][wanted[here]]]
            if len(here):
                made, translated = self._press(tuple(press.tolist()))
                packed[here] = translated[np.searchsorted(made, wanted[here])]
        table = {name: self._table[name][wanted] for name in GIVEN}
        table["reference"] = self._reference[wanted]
        lines = [self._source.sources[number] for number in self._table["source"][wanted]]
        return Frames(packed, table, lines)

    def _press(self, press: tuple[int, ...]) -> tuple[Rows, NDArray[np.uint8]]:
        """Return rows of the source (n,), ascending, and their translated masks (n, 38400).

        The press that was translated last is kept: it may go on behind the rows that were asked
        for.
        """
        if self._made is None or self._made[0] != press:
            of = (self._presses == np.array(press)).all(axis=1)
            rows = np.flatnonzero(of & self._table["valid"])
            rows = rows[np.argsort(self._table["frame"][rows], kind="stable")]
            masks = torch.from_numpy(self._source.masks(rows)).to(self._device)
            before = self._source.reference(int(rows[0]))
            packed = np.empty((len(rows), PACKED), np.uint8)
            for number in np.unique(self._reference[rows]).tolist():
                after = unpack(self._target.references[number])
                translated = self._translator.translate(
                    masks,
                    torch.from_numpy(after).to(self._device),
                    torch.from_numpy(before).to(self._device),
                    ordered=True,
                )
                seen = self._reference[rows] == number
                packed[seen] = pack(translated.cpu().numpy()[seen])
            order = np.argsort(rows)
            self._made = press, rows[order], packed[order]
        return self._made[1:]


def _sensor(archive: MarkerArchive, name: str) -> ArchivedSensor:
    if name not in archive:
        raise LearningError(
            f"{archive.name}: found no sensor {name!r}; known: {', '.join(archive)}"
        )
    sensor = archive[name]
    empty = np.flatnonzero(~sensor.references.any(axis=1))
    if len(empty):
        raise LearningError(
            f"{archive.name}: reference {empty[0]} of {name} is without a marker; allowed: a mask "
            "of the untouched sensor"
        )
    return sensor


def _rows_of(
    archive: MarkerArchive, pair: Pair, split: Split | None, roles: Sequence[Role]
) -> Rows:
    table = _sensor(archive, pair.source).table
    if split is None:
        return np.arange(len(table["frame"]), dtype=np.int64)
    rows = np.sort(split.rows(table, roles))
    if not len(rows):
        raise LearningError(
            f"{archive.name}: {pair.source} has no frames of role {', '.join(roles)}"
        )
    return rows


def _press_of(table: Mapping[str, np.ndarray[Any, Any]]) -> NDArray[np.int64]:
    """Return indenter, target and reference of each row (n, 3): equal in the rows of a press."""
    return np.stack([table[name] for name in ("indenter", "target", "reference")], axis=1).astype(
        np.int64
    )


def _in_order(presses: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the different presses (p, 3) in the order in which they first appear."""
    different, first = np.unique(presses, axis=0, return_index=True)
    return np.asarray(different[np.argsort(first)])


def _by_press(table: Mapping[str, np.ndarray[Any, Any]], rows: Rows) -> Rows:
    """Return rows with those of a press together and in order of time, presses as they come."""
    _, first, of = np.unique(_press_of(table)[rows], axis=0, return_index=True, return_inverse=True)
    return np.asarray(rows[np.lexsort((table["frame"][rows], first[of.reshape(-1)]))])


def target_references(
    locations: NDArray[np.integer[Any]], target: Mapping[str, np.ndarray[Any, Any]]
) -> NDArray[np.int16]:
    """Return which reference of the target belongs to each location of a source (n,).

    A target that drifts has one for each contact point: that of the same location. Where it was not
    pressed there, its first.
    """
    known = np.flatnonzero((target["location"] >= 0) & target["valid"])
    location, first = np.unique(target["location"][known], return_index=True)
    found = np.zeros(len(locations), np.int16)
    if len(location):
        place = np.minimum(np.searchsorted(location, locations), len(location) - 1)
        there = location[place] == locations
        found[there] = target["reference"][known[first[place[there]]]]
    return found


def _marker_count(sensor: ArchivedSensor) -> MarkerCount | None:
    found = sensor.attrs.get("marker_check")
    return None if found is None else MarkerCount(**found)


# A contact sheet of a translated archive: source, translated, the true target, what differs.

Masks = NDArray[np.bool_]

# Size of a picture, the space around it, the height of what stands above and below [px].
TILE, GAP, HEAD, CAPTION = (256, 192), 8, 30, 20
# Presses of a pair that are shown.
FRAMES = 3
# Colours of markers and ground, and of what is a marker in the translated frame or the true one
# alone.
MARKER, GROUND, ONLY_MADE, ONLY_TRUE = (240, 240, 236), (22, 26, 34), (255, 150, 30), (70, 150, 255)


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
