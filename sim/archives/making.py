"""One unit of an archive: its presses solved, what every sensor sees of them, and both written."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.archive import ArchiveWriter
from recorder.markers import PACKED, Lattice
from sim.archives.families import Family, Unit, families, force_scale, scenes
from sim.archives.plan import UNSEEN, Plan, code, names
from sim.archives.press import Press, Recording
from sim.archives.solving import Solved, solve
from sim.archives.views import Packed, Reader, reader
from sim.result import Result
from sim.sensors import SimulatedSensor, SurfaceField

LATTICE = Lattice()
"""Where displacement is kept."""


@dataclass(frozen=True, slots=True)
class Made:
    """What a unit took."""

    number: int
    """Of the unit."""
    images: int
    """Masks that it wrote."""
    solving: float
    """CPU time of its presses [s]; on a GPU the time that they took."""
    seeing: float
    """The same of images, fields, packing and writing."""


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of one unit of files of one sensor."""

    packed: Packed
    table: Mapping[str, Any]
    source: Sequence[str]
    displacement: NDArray[np.float16] | None


def make_unit(
    path: Path,
    plan: Plan,
    unit: Unit,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
) -> Made:
    """Solve, look and write; what is written already stays. Equal bytes every time on a CPU.

    Raises:
        SceneError: A scene that cannot be.
        OSError: The disk is full, or the archive went away.
    """
    clock = time.process_time if device == "cpu" else time.perf_counter
    family = families(plan)[unit.family]
    presses = family.presses[unit.first : unit.last]
    began = clock()
    solved = solve(scenes(plan, family, presses), plan.solving, device=device, progress=progress)
    pressed = clock()
    writer = ArchiveWriter(path)
    images = 0
    for sensor in family.sensors:
        images += _write(writer, plan, family, sensor, unit, presses, solved, device)
    return Made(unit.number, images, pressed - began, clock() - pressed)


def _write(
    writer: ArchiveWriter,
    plan: Plan,
    family: Family,
    sensor: SimulatedSensor,
    unit: Unit,
    presses: Sequence[Press],
    solved: Sequence[Solved],
    device: str,
) -> int:
    """Write the rows of one sensor; how many masks."""
    seen = reader(sensor, plan.seed, device)
    recordings = [
        (press, each, one)
        for press, each in zip(presses, solved, strict=True)
        for one in press.recordings
    ]
    images = 0
    for place, number in enumerate(unit.files):
        some = recordings[place * family.unit_presses : (place + 1) * family.unit_presses]
        parts = [_rows(plan, sensor, seen, press, each, one) for press, each, one in some]
        for index, name in enumerate(names(sensor)):
            images += sum(len(part.source) for part in parts)
            # Patterns of one sensor share its fields: the first has them.
            fields = [part.displacement for part in parts if part.displacement is not None]
            writer.sensors[name].write(
                number,
                packed=np.concatenate([part.packed[index] for part in parts]),
                table={
                    column: np.concatenate([part.table[column] for part in parts])
                    for column in parts[0].table
                },
                source=[line for part in parts for line in part.source],
                displacement=np.concatenate(fields) if fields and index == 0 else None,
            )
    return images


def _rows(
    plan: Plan,
    sensor: SimulatedSensor,
    seen: Reader,
    press: Press,
    solved: Solved,
    recording: Recording,
) -> Rows:
    """Rows of one recording; `packed` holds every pattern (P, F, 38400)."""
    count, frames = len(recording), list(recording.frames)
    tip = np.array(press.motion.tip)[frames]
    wrench = np.full((count, 6), np.nan)
    packed = np.zeros((len(names(sensor)), count, PACKED), np.uint8)
    fields = np.full((count, *LATTICE.shape), np.nan, np.float16) if seen.keeps_fields else None
    if solved.result is not None:
        top = _top(solved.result, frames)
        wrench = solved.result.wrench[frames] * force_scale(plan, sensor)
        packed = seen.packed(top, recording)
        fields = seen.displacement(top)
    table = {
        "indenter": np.full(count, code(press.indenter)),
        "seen": np.full(count, press.indenter not in UNSEEN),
        "location": np.array(recording.locations),
        "target": np.full(count, recording.target),
        "phase": np.array(recording.phases),
        "depth": np.maximum(-tip[:, 2], 0.0),
        "position": tip[:, :2],
        "wrench": wrench,
        "frame": np.arange(count),
        "t_ns": np.round(np.array(press.motion.time)[frames] * 1e9).astype(np.int64),
        "reference": np.full(count, seen.reference(recording)),
        "valid": np.full(count, solved.result is not None),
    }
    line = {"sensor": sensor.name, "indenter": press.indenter, "target": recording.target}
    text = json.dumps({**line, **solved.how}, ensure_ascii=False)
    return Rows(packed, table, [text] * count, fields)


def _top(result: Result, frames: list[int]) -> SurfaceField:
    return SurfaceField(result.surface_x, result.surface_y, result.surface[frames])
