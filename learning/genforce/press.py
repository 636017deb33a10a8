"""What the layouts have in common: presses as files and labels, and sensors made of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.filling import CHUNK_ROWS, UNIT_ROWS, Frames
from learning.flags import FLAG, Flagger
from recorder.archive import NO_PHASE, MarkerCount, SensorPlan
from recorder.markers import unpack

Array = NDArray[np.float64]
Packed = NDArray[np.uint8]
ReadMask = Callable[[Path], Packed]

NO_LOCATION = -1
NO_TIME = 0
"""What stands in `t_ns`: the folders have no times."""


@dataclass(frozen=True, slots=True, eq=False)
class Press:
    """One contact point of one indenter, frame by frame."""

    indenter: str
    target: int
    """Number of the press within the indenter, from 0."""
    files: tuple[Path, ...]
    """The file of each frame."""
    phase: NDArray[np.int64]
    """Code of the phase of each (n,); -1 for none."""
    wrench: Array
    """Forces and torques (n, 6) [N, N m]; NaN without a label."""
    depth: Array
    """How deep it is (n,) [m]."""
    position: Array
    """Where it is (n, 2) [m]."""
    location: NDArray[np.int64]
    """Location of each (n,); -1 for none."""
    reference: int = 0
    """Which reference its frames belong to."""

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.files)


@dataclass(frozen=True, slots=True, eq=False)
class PublishedSensor:
    """One sensor as folders have it: `learning.filling.SensorFrames`."""

    name: str
    presses: tuple[Press, ...]
    references: Packed
    """Packed masks of the untouched sensor (K, 38400)."""
    indenters: tuple[str, ...]
    """Names, by code."""
    mm_per_px: float
    read_mask: ReadMask
    """Makes the packed mask (38400,) of a frame's file."""
    root: Path
    """Files are told of relative to it."""
    unseen: tuple[str, ...]
    """Indenters that models may not be trained on."""
    marker_count: MarkerCount | None = None
    """How markers are counted; None: they are not."""
    attrs: Mapping[str, Any] = field(default_factory=dict)

    @property
    def plan(self) -> SensorPlan:
        """What the archive will hold."""
        return SensorPlan(
            name=self.name,
            rows=sum(len(press) for press in self.presses),
            chunk_rows=CHUNK_ROWS,
            unit_rows=UNIT_ROWS,
            references=self.references,
            mm_per_px=self.mm_per_px,
            marker_count=self.marker_count,
            attrs=self.attrs,
        )

    def read(self, rows: slice) -> Frames:
        """Read some of the frames.

        Raises:
            LearningError: A file that is damaged or of another shape, by name.
        """
        packed, parts = [], []
        lines: list[dict[str, Any]] = []
        begin = 0
        for press in self.presses:
            first, last = max(rows.start - begin, 0), min(rows.stop - begin, len(press))
            begin += len(press)
            if first >= last:
                continue
            packed += [self.read_mask(path) for path in press.files[first:last]]
            parts.append(self._table(press, first, last))
            line: dict[str, Any] = {
                "folder": press.files[0].parent.relative_to(self.root).as_posix(),
                "target": press.target,
            }
            lines += [dict(line) for _ in range(first, last)]
        table = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        frames = np.stack(packed)
        flagger = Flagger(self.name, self.references, self.marker_count)
        flags = flagger.flags(unpack(frames), table["reference"], table["valid"])
        for row, flag in flags.items():
            lines[row][FLAG] = flag
        return Frames(frames, table, [json.dumps(line, ensure_ascii=False) for line in lines])

    def _table(self, press: Press, first: int, last: int) -> dict[str, NDArray[Any]]:
        rows, count = slice(first, last), last - first
        return {
            "indenter": np.full(count, self.indenters.index(press.indenter)),
            "seen": np.full(count, press.indenter not in self.unseen),
            "location": press.location[rows],
            "target": np.full(count, press.target),
            "phase": press.phase[rows],
            "depth": press.depth[rows],
            "position": press.position[rows],
            "wrench": press.wrench[rows],
            "frame": np.arange(first, last),
            "t_ns": np.full(count, NO_TIME),
            "reference": np.full(count, press.reference),
            "valid": np.ones(count, np.bool_),
        }


def phases_of(last: Sequence[int]) -> NDArray[np.int64]:
    """Return the phase of each frame (n,), from the numbers of the last frames of the phases."""
    counts = np.diff([-1, *last])
    return np.repeat(np.arange(len(last)), counts)


def no_phases(count: int) -> NDArray[np.int64]:
    """Return the phases of frames that have none (n,)."""
    return np.full(count, NO_PHASE)
