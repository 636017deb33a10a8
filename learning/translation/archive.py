"""Translated archives: a sensor's frames as other sensors would have shown them, with labels.

The sensor `A-to-B` has the translated frames of A, the references and scale of B, and the table of
A (indenter, location, depth, wrench, forces of its twin). Whole presses are translated at a time so
that markers can be tracked. An interrupted run continues where it stopped.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from learning.contact_sheet import marker_picture, write_sheet
from learning.data.splits import Role, Split
from learning.errors import LearningError
from learning.translation.translator import SensorView, Translator, for_pair
from recorder.archive import (
    CHUNK_ROWS,
    GIVEN,
    UNIT_ROWS,
    ArchivedSensor,
    Frames,
    MarkerArchive,
    MarkerCount,
    SensorPlan,
    Simulated,
    archive_fingerprint,
    fill_archive,
    location_pairs,
)
from recorder.markers import PACKED, pack, unpack
from recorder.plot import Tile
from recorder.spec import PHASES

Rows = NDArray[np.int64]

# Attributes of the target that also hold for frames translated to it.
_OF_TARGET = ("pattern", "camera", "preset", "sensor", "description")


@dataclass(frozen=True, slots=True)
class Pair:
    """Source and target sensor of a translation."""

    source: str
    """Sensor whose frames are translated."""
    target: str
    """Sensor that they are translated to."""

    @property
    def name(self) -> str:
        """Name of the translated sensor."""
        return f"{self.source}-to-{self.target}"


@dataclass(frozen=True, slots=True)
class NamedTranslator:
    """A translator and its recorded identity."""

    translator: Translator
    """The translator, not yet specialised for a pair."""
    name: str
    """`flow`, or the name of the folder that it was loaded from."""
    sha256: str
    """SHA-256 of its weights; of its name if it has none."""
    device: str = "cpu"
    """Device on which it takes frames."""


def translate_archive(
    archive: MarkerArchive,
    out: Path,
    pairs: Sequence[Pair],
    model: NamedTranslator,
    *,
    split: Split | None = None,
    roles: Sequence[Role] = (),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> int:
    """Translate an archive for some pairs, or resume; return the number of frames written now.

    With a split, only its presses that have one of `roles`.
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
    twins = {each.plan.name: forces for each in sensors if (forces := each.simulated) is not None}
    return fill_archive(out, sensors, archive.indenters, attrs, progress, simulated=twins)


class TranslatedSensor:
    """Frames of one sensor, translated to another sensor on demand."""

    def __init__(
        self, archive: MarkerArchive, pair: Pair, model: NamedTranslator, rows: Rows
    ) -> None:
        """Prepare both sensors and the rows of the source; nothing is translated yet."""
        self._source, self._target = _sensor(archive, pair.source), _sensor(archive, pair.target)
        self._table = self._source.table
        # Equal for all rows of a press (n, 3).
        of_press = [self._table[name] for name in ("indenter", "target", "reference")]
        self._presses = np.stack(of_press, axis=1).astype(np.int64)
        # By press, in time order; presses in order of first appearance.
        _, first, of = np.unique(
            self._presses[rows], axis=0, return_index=True, return_inverse=True
        )
        order = np.lexsort((self._table["frame"][rows], first[of.reshape(-1)]))
        self._rows = np.asarray(rows[order])
        self._reference = target_references(self._table["location"], self._target.table)
        source, target = SensorView.of(self._source), SensorView.of(self._target)
        self._translator = for_pair(model.translator, source, target)
        self._device = model.device
        self._last_press: tuple[tuple[int, ...], Rows, NDArray[np.uint8]] | None = None
        check = self._target.attrs.get("marker_check")
        self.plan = SensorPlan(
            name=pair.name,
            rows=len(self._rows),
            chunk_rows=CHUNK_ROWS,
            unit_rows=UNIT_ROWS,
            references=self._target.references,
            mm_per_px=self._target.mm_per_px,
            marker_count=None if check is None else MarkerCount(**check),
            attrs={
                **{key: self._target.attrs[key] for key in _OF_TARGET if key in self._target.attrs},
                "source": pair.source,
                "target": pair.target,
                "model": model.name,
                "model_sha256": model.sha256,
            },
        )

    @property
    def simulated(self) -> Simulated | None:
        """Forces of the source's twin in its frames, None without."""
        simulated = self._source.simulated
        if simulated is None:
            return None
        return replace(
            simulated, force=simulated.force[self._rows], spread=simulated.spread[self._rows]
        )

    def read(self, rows: slice) -> Frames:
        """Translate some frames."""
        wanted = self._rows[rows]
        packed = np.zeros((len(wanted), PACKED), np.uint8)
        presses = self._presses[wanted]
        for press in dict.fromkeys(map(tuple, presses.tolist())):
            here = np.flatnonzero((presses == press).all(axis=1))
            here = here[self._table["valid"][wanted[here]]]
            if len(here):
                press_rows, translated = self._press(press)
                packed[here] = translated[np.searchsorted(press_rows, wanted[here])]
        table = {name: self._table[name][wanted] for name in GIVEN}
        table["reference"] = self._reference[wanted]
        lines = self._source.provenance(wanted)
        return Frames(packed, table, lines)

    def _press(self, press: tuple[int, ...]) -> tuple[Rows, NDArray[np.uint8]]:
        """Return rows of the source (n,), ascending, and their translated masks (n, 38400).

        The last translated press is cached, since it may extend beyond the requested rows.
        """
        if self._last_press is None or self._last_press[0] != press:
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
                of_reference = self._reference[rows] == number
                packed[of_reference] = pack(translated.cpu().numpy()[of_reference])
            order = np.argsort(rows)
            self._last_press = press, rows[order], packed[order]
        return self._last_press[1:]


def _sensor(archive: MarkerArchive, name: str) -> ArchivedSensor:
    if name not in archive:
        raise LearningError(
            f"{archive.name}: found no sensor {name!r}; known: {', '.join(archive)}"
        )
    sensor = archive[name]
    empty = np.flatnonzero(~sensor.references.any(axis=1))
    if len(empty):
        raise LearningError(
            f"{archive.name}: reference {empty[0]} of {name} has no marker; allowed: a mask "
            "of the sensor without contact"
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


def target_references(
    locations: NDArray[np.integer[Any]], target: Mapping[str, np.ndarray[Any, Any]]
) -> NDArray[np.int16]:
    """Return the target's reference for each location of a source (n,).

    A drifting target has one reference per contact point, and that of the same location is used.
    If the target was not pressed there, its first reference is used.
    """
    located = np.flatnonzero((target["location"] >= 0) & target["valid"])
    location, first = np.unique(target["location"][located], return_index=True)
    references = np.zeros(len(locations), np.int16)
    if len(location):
        index = np.minimum(np.searchsorted(location, locations), len(location) - 1)
        there = location[index] == locations
        references[there] = target["reference"][located[first[index[there]]]]
    return references


# A contact sheet of a translated archive: source, translation, true target, difference.

Masks = NDArray[np.bool_]

# Presses shown for each pair.
FRAMES = 3
# Colours of markers in only the translated or only the true frame.
ONLY_TRANSLATED, ONLY_TRUE = (255, 150, 30), (70, 150, 255)


def draw_sheet(archive: MarkerArchive, translated: MarkerArchive, out: Path) -> None:
    """Write a PNG contact sheet with evenly spaced presses of each pair of a translated archive."""
    rows = [row for sensor in translated.values() for row in _chosen(archive, sensor)]
    write_sheet(rows, out, columns=4, size=(256, 192))


def dice(one: Masks, other: Masks) -> float:
    """Return the Dice coefficient 2 |A and B| / (|A| + |B|) of two masks; 1 if both are empty."""
    total = int(np.count_nonzero(one)) + int(np.count_nonzero(other))
    return 2 * int(np.count_nonzero(one & other)) / total if total else 1.0


def _chosen(
    archive: MarkerArchive, translated: ArchivedSensor
) -> Iterator[tuple[str, str, list[Tile]]]:
    """Yield title, note and pictures of some of the deepest frames of a pair."""
    names = [translated.attrs.get(key) for key in ("source", "target")]
    for name in names:
        if name not in archive:
            raise LearningError(
                f"{archive.name}: found no sensor {name!r}, which {translated.name} was made from"
            )
    source, target = (archive[str(name)] for name in names)
    rows = np.flatnonzero(translated.table["valid"])
    deepest = rows[
        translated.table["depth"][rows] >= np.quantile(translated.table["depth"][rows], 0.7)
    ]
    pairs = location_pairs(translated.table, target.table)
    paired = np.isin(pairs.source, deepest)
    of = dict(zip(pairs.source[paired].tolist(), pairs.target[paired].tolist(), strict=True))
    pool = np.array(sorted(of)) if of else deepest
    for row in pool[np.linspace(0, len(pool) - 1, min(FRAMES, len(pool))).astype(int)].tolist():
        (before,) = source.masks([_row_of(source, translated, row)])
        (after,) = translated.masks([row])
        tiles = [
            Tile(marker_picture(before), ("source", "")),
            Tile(marker_picture(after), ("translated", "")),
        ]
        if row in of:
            (true,) = target.masks([of[row]])
            agreement = f"Dice {dice(after, true):.3f}: orange too much, blue missing"
            tiles += [
                Tile(marker_picture(true), ("target, pressed there", "")),
                Tile(_difference(after, true), (agreement, "")),
            ]
        yield _title(archive, translated, row), "", tiles


def _row_of(source: ArchivedSensor, translated: ArchivedSensor, row: int) -> int:
    same = np.ones(len(source), np.bool_)
    for name in ("indenter", "target", "location", "frame"):
        same &= source.table[name] == translated.table[name][row]
    matches = np.flatnonzero(same)
    if not len(matches):
        raise LearningError(f"{translated.name}: row {row} was made from no frame of {source.name}")
    return int(matches[0])


def _title(archive: MarkerArchive, translated: ArchivedSensor, row: int) -> str:
    table = translated.table
    code = int(table["phase"][row])
    phase = PHASES[code].replace("_", " ") if code >= 0 else "no phase"
    indenter = archive.indenters[int(table["indenter"][row])]
    depth = 1e3 * table["depth"][row]
    return f"{translated.name}: {indenter}, target {table['target'][row]}, {phase}, {depth:.2f} mm"


def _difference(translated: Masks, true: Masks) -> NDArray[np.uint8]:
    picture = marker_picture(translated & true)
    picture[translated & ~true] = ONLY_TRANSLATED
    picture[true & ~translated] = ONLY_TRUE
    return picture
