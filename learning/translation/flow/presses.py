"""Fields of many presses, by as many processes as there are cores: for whoever warps on a GPU.

Markers are followed on the CPU, a press at a time; presses are independent. A GPU warps thousands
of frames a second, so what feeds it has to be spread.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.translation.flow.fields import LATTICE, MAP_SIDE, FieldReader
from learning.translation.translator import SensorView
from recorder.markers import PACKED, unpack

Form = Literal["displacement", "maps"]
"""Fields on the lattice of archives (n, 57, 73, 2), or small maps (n, 3, 32, 32)."""

_PRESSES = 8  # a process takes so many at once


@dataclass(frozen=True, slots=True, eq=False)
class PackedPresses:
    """Presses of one sensor, in packed masks."""

    packed: NDArray[np.uint8]
    """All frames (n, 38400), those of a press together, in order of time."""
    starts: NDArray[np.int64]
    """First frame of each press, and the number of frames (p + 1,)."""
    references: NDArray[np.uint8]
    """Packed untouched masks (k, 38400)."""
    reference: NDArray[np.integer[Any]]
    """Which of them each frame belongs to (n,); one in all frames of a press."""

    def __post_init__(self) -> None:
        """Refuse parts that do not fit together.

        Raises:
            LearningError: Naming the field.
        """
        for name in ("packed", "references"):
            found = getattr(self, name)
            if found.dtype != np.uint8 or found.ndim != 2 or found.shape[1] != PACKED:
                raise LearningError(
                    f"{name}: found {found.dtype} {found.shape}; allowed: uint8 (n, {PACKED})"
                )
        rising = len(self.starts) > 1 and self.starts[0] == 0 and (np.diff(self.starts) > 0).all()
        if not rising or self.starts[-1] != len(self.packed):
            raise LearningError(
                f"starts: allowed: ascending from 0 to the number of frames, {len(self.packed)}"
            )
        if self.reference.shape != (len(self.packed),):
            raise LearningError(
                f"reference: found shape {self.reference.shape}; allowed: ({len(self.packed)},)"
            )

    def __len__(self) -> int:
        """Return the number of presses."""
        return len(self.starts) - 1


def fields_of_presses(
    presses: PackedPresses,
    form: Form = "displacement",
    *,
    source: SensorView | None = None,
    target: SensorView | None = None,
    processes: int = 1,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> NDArray[np.floating[Any]]:
    """Return the fields of all frames: displacement as float16, maps as float32.

    Args:
        presses: The frames.
        form: Which fields.
        source: What the frames show; None: the same as the target's.
        target: Whose image a displacement is for.
        processes: How many compute.
        progress: Called with the frames that are done and those there are.

    Raises:
        LearningError: A reference without markers.
    """
    total = len(presses.packed)
    shape = LATTICE.shape if form == "displacement" else (3, MAP_SIDE, MAP_SIDE)
    fields = np.empty((total, *shape), np.float16 if form == "displacement" else np.float32)
    progress(0, total)
    for first, part in _computed(list(_jobs(presses, form, source, target)), processes):
        fields[first : first + len(part)] = part
        progress(first + len(part), total)
    return fields


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """Some presses, and the references that they need."""

    first: int
    presses: PackedPresses
    form: Form
    source: SensorView | None
    target: SensorView | None


def _jobs(
    presses: PackedPresses, form: Form, source: SensorView | None, target: SensorView | None
) -> Iterator[_Job]:
    for number in range(0, len(presses), _PRESSES):
        starts = presses.starts[number : number + _PRESSES + 1]
        first, end = int(starts[0]), int(starts[-1])
        used, reference = np.unique(presses.reference[first:end], return_inverse=True)
        part = PackedPresses(
            presses.packed[first:end],
            starts - first,
            presses.references[used],
            reference.reshape(-1),
        )
        yield _Job(first, part, form, source, target)


def _computed(jobs: list[_Job], processes: int) -> Iterator[tuple[int, NDArray[np.floating[Any]]]]:
    if processes < 2 or len(jobs) < 2:
        yield from map(_fields, jobs)
        return
    # Forking a process in which torch has threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(jobs)), mp_context=context) as pool:
        yield from pool.map(_fields, jobs)


def _fields(job: _Job) -> tuple[int, NDArray[np.floating[Any]]]:
    presses = job.presses
    readers: dict[int, FieldReader] = {}
    parts: list[NDArray[np.floating[Any]]] = []
    for first, end in zip(presses.starts[:-1], presses.starts[1:], strict=True):
        number = int(presses.reference[first])
        if number not in readers:
            readers[number] = FieldReader(unpack(presses.references[number]))
        frames = presses.packed[first:end]
        if job.form == "maps":
            parts.append(readers[number].maps(frames, ordered=True))
        else:
            field = readers[number].displacement(
                frames, ordered=True, source=job.source, target=job.target
            )
            parts.append(field.astype(np.float16))
    return job.first, np.concatenate(parts)
