"""Make one unit of an archive: solve its presses, render every sensor's images, write both."""

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.archive import ArchiveWriter, Frames
from recorder.markers import PACKED, Lattice, pack
from recorder.processes import Workers, results
from recorder.progress import part_of, span_of
from sim.arrays import Array, Progress
from sim.dataset.plan import (
    UNSEEN,
    DatasetPlan,
    Family,
    PlannedPress,
    PressRecording,
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
from sim.sensors import CameraReadout, SimulatedSensor, SurfaceField, TaxelReadout, readout

# The readings of each sensor of an archive: masks, displacement fields and references.

Packed = NDArray[np.uint8]


class SensorReader:
    """Reader of one sensor of an archive; keeps constant data between calls."""

    def __init__(self, sensor: SimulatedSensor, seed: int, device: str, indenters: int) -> None:
        """Mount the sensor with the deviations in its `variation`, drawn by the seed.

        `indenters` is the number of them in its session, by code.
        """
        self.sensor = sensor
        self.readout = readout(sensor, seed=seed, device=device)
        # A lab picks a good reference, so it has no segmentation errors and no noise.
        careful = replace(sensor, variation=replace(sensor.variation, segmentation=None))
        taxels = isinstance(self.readout, TaxelReadout)
        self._still = readout(careful, seed=None if taxels else seed, device=device)
        self._creep = creep(sensor, seed, indenters)

    def references(self) -> Packed:
        """Return packed masks (P, K, 38400) of the sensor without contact, one per creep offset."""
        still = SurfaceField.undeformed(self.sensor.body)
        masks = [self._still.masks(still.crept(offset))[0] for offset in self._creep]
        return np.stack([pack(each) for each in masks], axis=1)

    def packed(self, top: SurfaceField, recording: PressRecording) -> Packed:
        """Return packed masks (P, F, 38400) of the frames of a recording."""
        top = top.crept(self._creep[self.reference(recording)])
        packed = self.readout.packed(top, recording.number * len(recording))
        return np.moveaxis(packed, 1, 0)

    def reference(self, recording: PressRecording) -> int:
        """Return the index of the reference of a recording."""
        return recording.session_point if len(self._creep) > 1 else 0


@functools.lru_cache(maxsize=32)
def sensor_reader(sensor: SimulatedSensor, seed: int, device: str, indenters: int) -> SensorReader:
    """Return the reader of a sensor, cached within the process."""
    return SensorReader(sensor, seed, device, indenters)


def creep(sensor: SimulatedSensor, seed: int, indenters: int) -> Array:
    """Return the offset of the skin at each contact point of its session (K, 2) [m].

    Offsets follow one random walk over all indenters in their order, so that a point's offset does
    not depend on which indenters are simulated.
    """
    if sensor.variation.drift is None or sensor.trajectory is None:
        return np.zeros((1, 2))
    points = indenters * len(sensor.trajectory.points)
    return sensor.variation.drift.drawn(points, seed, sensor.name)


# Pixels at which displacement is stored.
LATTICE = Lattice()


# Part of a unit's progress that is solving; the rest is drawing and writing images.
SOLVING = 0.7


def make_unit(
    path: Path,
    plan: DatasetPlan,
    unit: Unit,
    device: str = "cpu",
    progress: Progress | None = None,
    workers: Workers | None = None,
) -> int:
    """Solve, render and write one unit, and return the number of masks written.

    Existing files are kept. Reproducible to the byte on a CPU, whether this process renders or
    `workers` do. `progress` is called with the fraction done.
    """
    family = families(plan)[unit.family]
    presses = family.presses[unit.first : unit.last]
    progress = progress or (lambda _fraction: None)
    solving = span_of(progress, 0.0, SOLVING)
    solved = solve(scenes(plan, family, presses), plan.solving, device=device, progress=solving)
    writer = ArchiveWriter(path)
    images, drawing = 0, span_of(progress, SOLVING, 1 - SOLVING)
    for index, sensor in enumerate(family.sensors):
        inside = part_of(drawing, index, len(family.sensors))
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
    progress: Progress,
) -> int:
    """Write the rows of one sensor and return the number of masks."""
    recordings = [
        (press, each, one)
        for press, each in zip(presses, solved, strict=True)
        for one in press.recordings
    ]
    images = 0
    for file_index, number in enumerate(unit.files):
        some = recordings[file_index * family.unit_presses : (file_index + 1) * family.unit_presses]
        parts = []
        due = [
            (plan, sensor, device, press, recording, _state(each, recording), each.how)
            for press, each, recording in some
        ]
        for part in results(workers, _rows, due):
            parts.append(part)
            progress((file_index * family.unit_presses + len(parts)) / len(recordings))
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


def _state(solved: Solved, recording: PressRecording) -> tuple[SurfaceField, Array] | None:
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
    recording: PressRecording,
    state: tuple[SurfaceField, Array] | None,
    how: Mapping[str, Any],
) -> Frames:
    """Return the rows of one recording; `packed` holds all patterns (P, F, 38400)."""
    reader = sensor_reader(sensor, plan.seed, device, len(indenter_names(plan)))
    count, frames = len(recording), list(recording.frames)
    tip = np.array(press.motion.tip)[frames]
    wrench = np.full((count, 6), np.nan)
    packed = np.zeros((len(names(sensor)), count, PACKED), np.uint8)
    fields = None
    if isinstance(reader.readout, CameraReadout):
        fields = np.full((count, *LATTICE.shape), np.nan, np.float16)
    if state is not None:
        top, forces = state
        wrench = forces * force_scale(plan, sensor)
        packed = reader.packed(top, recording)
        # From the recording's reference, which already includes creep from before the press.
        fields = reader.readout.displacement(top)
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
        "reference": np.full(count, reader.reference(recording)),
        "valid": np.full(count, state is not None),
    }
    line = {"sensor": sensor.name, "indenter": press.indenter, "target": recording.target}
    text = json.dumps({**line, **how}, ensure_ascii=False)
    return Frames(packed, table, [text] * count, fields)
