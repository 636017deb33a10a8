"""What each sensor of an archive gives of a deformation: masks, fields, and its references."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from recorder.markers import pack
from sim.archives.press import Recording
from sim.archives.targets import session_points
from sim.camera import Camera
from sim.errors import SceneError
from sim.sensors import (
    CameraReadout,
    CameraSignal,
    SimulatedSensor,
    SurfaceField,
    TaxelReadout,
    readout,
)

Array = NDArray[np.float64]
Packed = NDArray[np.uint8]
Fields = NDArray[np.float16]

TAXEL_PITCH_PX = 128
"""Columns from one taxel to the next in the image of discs (`recorder.markers.draw_discs`)."""


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
