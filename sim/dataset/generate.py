"""One unit of an archive: its presses solved, what every sensor sees of them, and both written."""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.archive import ArchiveWriter
from recorder.markers import PACKED, Lattice, pack
from sim.dataset.plan import (
    UNSEEN,
    Family,
    Plan,
    Press,
    Recording,
    Solved,
    Unit,
    code,
    families,
    force_scale,
    names,
    scenes,
    session_points,
    solve,
)
from sim.errors import SceneError
from sim.markers import Camera
from sim.result import Result
from sim.sensors import (
    CameraReadout,
    CameraSignal,
    SimulatedSensor,
    SurfaceField,
    TaxelReadout,
    readout,
)

# What each sensor of an archive gives of a deformation: masks, fields, and its references.

Array = NDArray[np.float64]
Packed = NDArray[np.uint8]
Fields = NDArray[np.float16]

# Columns from one taxel to the next in the image of discs (`recorder.markers.draw_discs`).
TAXEL_PITCH_PX = 128


class Reader:
    """Reads one sensor of an archive; keeps what is computed once."""

    def __init__(self, sensor: SimulatedSensor, seed: int, device: str) -> None:
        """Mount the sensor as its life has it."""
        self.sensor = sensor
        self._readout = readout(sensor, seed=seed, device=device)
        # A reference is chosen with care: it has no errors of segmentation and no noise.
        careful = replace(sensor, life=replace(sensor.life, segmentation=None))
        taxels = isinstance(self._readout, TaxelReadout)
        self._still = readout(careful, seed=None if taxels else seed, device=device)
        self._creep = creep(sensor, seed)

    @property
    def mm_per_px(self) -> float:
        """Size of a pixel on the untouched top [mm], along columns."""
        signal = self.sensor.signal
        if isinstance(signal, CameraSignal):
            return signal.camera().mm_per_px
        return signal.pitch * 1e3 / TAXEL_PITCH_PX

    @property
    def camera(self) -> Camera:
        """The camera as it is mounted.

        Raises:
            SceneError: A sensor of taxels.
        """
        if isinstance(self._readout, CameraReadout):
            return self._readout.camera
        raise SceneError(f"{self.sensor.name}.signal: taxels; allowed: a camera")

    @property
    def keeps_fields(self) -> bool:
        """Whether there is a displacement to keep: a camera's."""
        return isinstance(self._readout, CameraReadout)

    def references(self) -> Packed:
        """Packed masks of the untouched sensor (P, K, 38400), one per place of its creep."""
        still = SurfaceField.untouched(self.sensor.body)
        masks = [self._still.masks(crept(still, offset))[0] for offset in self._creep]
        return np.stack([pack(each) for each in masks], axis=1)

    def packed(self, top: SurfaceField, recording: Recording) -> Packed:
        """Packed masks (P, F, 38400) of the frames of a recording."""
        top = crept(top, self._creep[self.reference(recording)])
        first = recording.number * len(recording)
        if isinstance(self._readout, CameraReadout):
            return np.moveaxis(self._readout.packed(top, first), 1, 0)
        return np.moveaxis(pack(self._readout.masks(top, first)), 1, 0)

    def reference(self, recording: Recording) -> int:
        """Number of the reference of a recording."""
        return recording.session_point if len(self._creep) > 1 else 0

    def displacement(self, top: SurfaceField) -> Fields | None:
        """Fields (F, rows, columns, 2) [px], from the reference of the recording; None of taxels.

        A skin that crept before the press is named by where it lies, so its creep is not in them.
        """
        if isinstance(self._readout, CameraReadout):
            return self._readout.displacement(top)
        return None


@functools.lru_cache(maxsize=32)
def reader(sensor: SimulatedSensor, seed: int, device: str) -> Reader:
    """The reader of a sensor; made once in a process."""
    return Reader(sensor, seed, device)


def creep(sensor: SimulatedSensor, seed: int) -> Array:
    """How far the skin lies from its place at each contact point of its session (K, 2) [m].

    One walk over all indenters, in their order: a point stands where it stood in the whole session,
    whichever of them are simulated.
    """
    if sensor.life.drift is None or sensor.trajectory is None:
        return np.zeros((1, 2))
    return sensor.life.drift.drawn(session_points(sensor.trajectory), seed, sensor.name)


def crept(top: SurfaceField, offset: Array) -> SurfaceField:
    """The field of a skin that crept by `offset` [m] before the indenter pressed.

    The indenter stays where it is: u(X) becomes offset + u(X + offset).
    """
    if not offset.any():
        return top
    shift = np.array([*offset, 0.0], np.float32)
    return SurfaceField(top.x - offset[0], top.y - offset[1], top.displacement + shift)


# Where displacement is kept.
LATTICE = Lattice()


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
