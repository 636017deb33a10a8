"""Make one unit of an archive: solve its presses, render every sensor's images, write both."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.archive import ArchiveWriter
from recorder.markers import PACKED, Lattice, pack
from recorder.processes import Workers
from recorder.progress import part_of, span_of
from sim.dataset.plan import (
    UNSEEN,
    DatasetPlan,
    Family,
    PlannedPress,
    Recording,
    Solved,
    Unit,
    code,
    families,
    force_scale,
    indenter_names,
    names,
    scenes,
    solve,
)
from sim.errors import SceneError
from sim.markers import Camera
from sim.sensors import (
    CameraReadout,
    CameraSignal,
    SimulatedSensor,
    SurfaceField,
    TaxelReadout,
    readout,
)

# The readings of each sensor of an archive: masks, displacement fields and references.

Array = NDArray[np.float64]
Packed = NDArray[np.uint8]
Fields = NDArray[np.float16]

# Distance between taxels in the image of discs [columns] (`recorder.markers.draw_discs`).
TAXEL_PITCH_PX = 128


class Reader:
    """Reader of one sensor of an archive; keeps constant data between calls."""

    def __init__(self, sensor: SimulatedSensor, seed: int, device: str, indenters: int) -> None:
        """Mount the sensor with the deviations in its `variation`.

        Args:
            sensor: The sensor.
            seed: Seed of all draws.
            device: Device of the renderer.
            indenters: Number of indenters in its session, by code.
        """
        self.sensor = sensor
        self._readout = readout(sensor, seed=seed, device=device)
        # A lab picks a good reference, so it has no segmentation errors and no noise.
        careful = replace(sensor, variation=replace(sensor.variation, segmentation=None))
        taxels = isinstance(self._readout, TaxelReadout)
        self._still = readout(careful, seed=None if taxels else seed, device=device)
        self._creep = creep(sensor, seed, indenters)

    @property
    def mm_per_px(self) -> float:
        """Size of a pixel on the undeformed top [mm], along columns."""
        signal = self.sensor.signal
        if isinstance(signal, CameraSignal):
            return signal.camera().mm_per_px
        return signal.pitch * 1e3 / TAXEL_PITCH_PX

    @property
    def camera(self) -> Camera:
        """The camera as mounted."""
        if isinstance(self._readout, CameraReadout):
            return self._readout.camera
        raise SceneError(f"{self.sensor.name}.signal: taxels; allowed: a camera")

    @property
    def keeps_fields(self) -> bool:
        """True if the sensor has displacement fields to store; only cameras do."""
        return isinstance(self._readout, CameraReadout)

    def references(self) -> Packed:
        """Return packed masks (P, K, 38400) of the sensor without contact, one per creep offset."""
        still = SurfaceField.undeformed(self.sensor.body)
        masks = [self._still.masks(crept(still, offset))[0] for offset in self._creep]
        return np.stack([pack(each) for each in masks], axis=1)

    def packed(self, top: SurfaceField, recording: Recording) -> Packed:
        """Return packed masks (P, F, 38400) of the frames of a recording."""
        top = crept(top, self._creep[self.reference(recording)])
        first = recording.number * len(recording)
        if isinstance(self._readout, CameraReadout):
            return np.moveaxis(self._readout.packed(top, first), 1, 0)
        return np.moveaxis(pack(self._readout.masks(top, first)), 1, 0)

    def reference(self, recording: Recording) -> int:
        """Return the index of the reference of a recording."""
        return recording.session_point if len(self._creep) > 1 else 0

    def displacement(self, top: SurfaceField) -> Fields | None:
        """Return fields (F, rows, columns, 2) [px] from the recording's reference; None for taxels.

        The reference already includes creep from before the press, so the fields do not.
        """
        if isinstance(self._readout, CameraReadout):
            return self._readout.displacement(top)
        return None


@functools.lru_cache(maxsize=32)
def reader(sensor: SimulatedSensor, seed: int, device: str, indenters: int) -> Reader:
    """Return the reader of a sensor, cached within the process."""
    return Reader(sensor, seed, device, indenters)


def creep(sensor: SimulatedSensor, seed: int, indenters: int) -> Array:
    """Return the offset of the skin at each contact point of its session (K, 2) [m].

    Offsets follow one random walk over all indenters in their order, so that a point's offset does
    not depend on which indenters are simulated.
    """
    if sensor.variation.drift is None or sensor.trajectory is None:
        return np.zeros((1, 2))
    points = indenters * len(sensor.trajectory.points)
    return sensor.variation.drift.drawn(points, seed, sensor.name)


def crept(top: SurfaceField, offset: Array) -> SurfaceField:
    """Return the field of a skin that crept by `offset` [m] before the indenter pressed.

    The indenter does not move with it: u(X) becomes offset + u(X + offset).
    """
    if not offset.any():
        return top
    shift = np.array([*offset, 0.0], np.float32)
    return SurfaceField(top.x - offset[0], top.y - offset[1], top.displacement + shift)


# Pixels at which displacement is stored.
LATTICE = Lattice()


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of one sensor within one unit of files."""

    packed: Packed
    table: Mapping[str, Any]
    source: Sequence[str]
    displacement: NDArray[np.float16] | None


# Part of a unit's progress that is solving; the rest is drawing and writing images.
SOLVING = 0.7


def make_unit(
    path: Path,
    plan: DatasetPlan,
    unit: Unit,
    device: str = "cpu",
    progress: Callable[[float], None] | None = None,
    workers: Workers | None = None,
) -> int:
    """Solve, render and write one unit, and return the number of masks written.

    Existing files are kept. Reproducible to the byte on a CPU.

    Args:
        path: The archive.
        plan: Its plan.
        unit: The unit.
        device: Device to solve and render on.
        progress: Called with the fraction done.
        workers: Processes that render; None: this one does. Files are the same.

    Raises:
        SceneError: A scene is invalid.
        OSError: The disk is full, or the archive was removed.
        WorkerLost: A process was killed.
    """
    family = families(plan)[unit.family]
    presses = family.presses[unit.first : unit.last]
    progress = progress or (lambda _fraction: None)
    solving = span_of(progress, 0.0, SOLVING)
    solved = solve(scenes(plan, family, presses), plan.solving, device=device, progress=solving)
    writer = ArchiveWriter(path)
    images, drawing = 0, span_of(progress, SOLVING, 1 - SOLVING)
    for place, sensor in enumerate(family.sensors):
        inside = part_of(drawing, place, len(family.sensors))
        parts = (writer, plan, family, sensor, unit, presses, solved)
        images += _write(*parts, device=device, workers=workers, progress=inside)
    return images


def _write(
    writer: ArchiveWriter,
    plan: DatasetPlan,
    family: Family,
    sensor: SimulatedSensor,
    unit: Unit,
    presses: Sequence[PlannedPress],
    solved: Sequence[Solved],
    *,
    device: str,
    workers: Workers | None,
    progress: Callable[[float], None],
) -> int:
    """Write the rows of one sensor and return the number of masks."""
    recordings = [
        (press, each, one)
        for press, each in zip(presses, solved, strict=True)
        for one in press.recordings
    ]
    images = 0
    for place, number in enumerate(unit.files):
        some = recordings[place * family.unit_presses : (place + 1) * family.unit_presses]
        parts = []
        for part in _rows_of_all(plan, sensor, some, device, workers):
            parts.append(part)
            progress((place * family.unit_presses + len(parts)) / len(recordings))
        for index, name in enumerate(names(sensor)):
            images += sum(len(part.source) for part in parts)
            # Patterns of one sensor share its fields, which are stored with the first.
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


def _rows_of_all(
    plan: DatasetPlan,
    sensor: SimulatedSensor,
    recordings: Sequence[tuple[PlannedPress, Solved, Recording]],
    device: str,
    workers: Workers | None,
) -> Iterator[Rows]:
    """Yield the rows of recordings in their order."""
    due = [
        (plan, sensor, device, press, recording, _state(solved, recording), solved.how)
        for press, solved, recording in recordings
    ]
    if workers is None:
        yield from (_rows(*each) for each in due)
        return
    for waiting in [workers.submit(_rows, *each) for each in due]:
        yield waiting.result()


def _state(solved: Solved, recording: Recording) -> tuple[SurfaceField, Array] | None:
    """Return top and wrench (F, 6) in the frames of a recording; None without a solution."""
    if solved.result is None:
        return None
    frames, result = list(recording.frames), solved.result
    top = SurfaceField(result.surface_x, result.surface_y, result.surface[frames])
    return top, result.wrench[frames]


def _rows(
    plan: DatasetPlan,
    sensor: SimulatedSensor,
    device: str,
    press: PlannedPress,
    recording: Recording,
    state: tuple[SurfaceField, Array] | None,
    how: Mapping[str, Any],
) -> Rows:
    """Return the rows of one recording; `packed` holds all patterns (P, F, 38400)."""
    seen = reader(sensor, plan.seed, device, len(indenter_names(plan)))
    count, frames = len(recording), list(recording.frames)
    tip = np.array(press.motion.tip)[frames]
    wrench = np.full((count, 6), np.nan)
    packed = np.zeros((len(names(sensor)), count, PACKED), np.uint8)
    fields = np.full((count, *LATTICE.shape), np.nan, np.float16) if seen.keeps_fields else None
    if state is not None:
        top, forces = state
        wrench = forces * force_scale(plan, sensor)
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
        "valid": np.full(count, state is not None),
    }
    line = {"sensor": sensor.name, "indenter": press.indenter, "target": recording.target}
    text = json.dumps({**line, **how}, ensure_ascii=False)
    return Rows(packed, table, [text] * count, fields)
