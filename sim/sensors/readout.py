"""Compute marker images and counts from the deformation of a sensor's top."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from recorder.markers import HEIGHT, WIDTH, draw_discs, pack
from sim.arrays import Array
from sim.markers import Camera, Pattern
from sim.sensors.field import SurfaceField
from sim.sensors.pins import tip_coverage
from sim.sensors.sensor import CameraSignal, SimulatedSensor
from sim.sensors.taxels import Counts, TaxelPad, TaxelSignal
from sim.sensors.variation import Placement, SegmentationErrors, generator

if TYPE_CHECKING:
    from sim.markers.renderer import View

Masks = NDArray[np.bool_]
# Distance between taxels in the image of discs [columns] (`recorder.markers.draw_discs`).
TAXEL_PITCH_PX = 128
# Least coverage at which a pixel counts as marker, of 255.
COVERED = 128


def readout(
    sensor: SimulatedSensor, *, seed: int | None = None, device: str = "cpu"
) -> CameraReadout | TaxelReadout:
    """Return the readout of a sensor.

    The seed is that of its noise and of the variations in its `variation`; None disables both.
    """
    if isinstance(sensor.signal, TaxelSignal):
        return TaxelReadout(sensor, sensor.signal, seed)
    return CameraReadout(sensor, sensor.signal, seed, device)


class TaxelReadout:
    """Readout of a pad of taxels: counts, and the image of discs drawn from them."""

    patterns = ("taxels",)

    def __init__(self, sensor: SimulatedSensor, signal: TaxelSignal, seed: int | None) -> None:
        self._pad = TaxelPad(sensor.body, signal)
        self.mm_per_px = signal.pitch * 1e3 / TAXEL_PITCH_PX
        """Size of a pixel [mm], along columns."""
        self._placement = _placement(sensor, seed)
        self._seed, self._name = seed, sensor.name

    def counts(self, top: SurfaceField, first: int = 0) -> Counts:
        """Return counts (F, n, 3) minus those of the pad without contact."""
        return self._pad.counts(self._placement.field(top), self._noise(len(top), first))

    def raw(self, top: SurfaceField, first: int = 0) -> Counts:
        """Return raw counts (F, n, 3) as the device sends them."""
        return self._pad.raw(self._placement.field(top), self._noise(len(top), first))

    def masks(self, top: SurfaceField, first: int = 0) -> Masks:
        """Return images of discs (F, 1, 480, 640)."""
        return draw_discs(self.counts(top, first))[:, None]

    def packed(self, top: SurfaceField, first: int = 0) -> NDArray[np.uint8]:
        """Return the same images as packed bits (F, 1, 38400)."""
        return pack(self.masks(top, first))

    def displacement(self, top: SurfaceField) -> None:
        """Return None: discs are no points of the skin."""

    def _noise(self, frames: int, first: int) -> Array | None:
        if self._seed is None:
            return None
        shape = (len(self._pad.signal.places), 3)
        return np.stack(
            [
                generator(self._seed, "taxels", self._name, first + frame).normal(size=shape)
                for frame in range(frames)
            ]
        )


class CameraReadout:
    """Readout of a camera below the gel: marker masks and their displacement."""

    def __init__(
        self, sensor: SimulatedSensor, signal: CameraSignal, seed: int | None, device: str
    ) -> None:
        from sim.markers import Renderer

        self._signal, self._placement = signal, _placement(sensor, seed)
        self.camera = _framed(sensor, signal, seed)
        """The camera as mounted."""
        self.mm_per_px = signal.camera().mm_per_px
        """Size of a pixel on the undeformed top [mm]."""
        self._patterns = signal.drawn()
        self.patterns = signal.patterns
        self._renderer = Renderer(sensor.body, self.camera, device=device)
        self._textures = self._renderer.textures(self._patterns)
        errors = sensor.variation.segmentation
        self._segmentation_errors = (
            []
            if errors is None or seed is None
            else [SegmentationErrors(errors, seed, sensor.name, name) for name in self.patterns]
        )

    def visible(self, top: SurfaceField) -> SurfaceField:
        """Return the visible surface in the sensor's frame: the skin, or the tips of its pins."""
        turned = self._placement.field(top)
        return turned if self._signal.pins is None else self._signal.pins.tips(turned)

    def coverage(self, top: SurfaceField) -> NDArray[np.uint8]:
        """Return each pixel's coverage by markers (F, P, 480, 640), 255 if complete."""
        if self._signal.pins is None:
            return self._view(top).coverage(self._textures)
        tips = self.visible(top)
        return np.stack([self._tips(tips, pattern) for pattern in self._patterns], axis=1)

    def masks(self, top: SurfaceField, first: int = 0) -> Masks:
        """Return masks (F, P, 480, 640), with segmentation errors if the sensor has them."""
        if not self._segmentation_errors and self._signal.pins is None:
            return self._view(top).masks(self._textures)
        coverage = self.coverage(top)
        if not self._segmentation_errors:
            return coverage >= COVERED
        masks = [
            errors.masks(coverage[:, index], first)
            for index, errors in enumerate(self._segmentation_errors)
        ]
        return np.stack(masks, axis=1)

    def packed(self, top: SurfaceField, first: int = 0) -> NDArray[np.uint8]:
        """Return the same masks as packed bits (F, P, 38400), without intermediate unpacking."""
        if self._segmentation_errors or self._signal.pins is not None:
            return pack(self.masks(top, first))
        return self._view(top).packed(self._textures)

    def displacement(self, top: SurfaceField) -> NDArray[np.float16]:
        """Return the displacement (F, rows, columns, 2) [px] of points on a lattice of pixels.

        The lattice is in the image without contact; NaN where that image shows no gel.
        """
        visible = self.visible(top)
        return self._renderer.displacement(visible.x, visible.y, visible.displacement)

    def _view(self, top: SurfaceField) -> View:
        visible = self.visible(top)
        return self._renderer.see(visible.x, visible.y, visible.displacement)

    def _tips(self, tips: SurfaceField, pattern: Pattern) -> NDArray[np.uint8]:
        """Return the coverage (F, 480, 640) by rigid, round tips of pins."""
        centres = pattern.centres
        points = np.concatenate([centres, np.zeros((len(centres), 1))], axis=1) + tips.at(centres)
        nearness = self.camera.focal / self.camera.depths(points)
        return tip_coverage(
            self.camera.project(points), pattern.size / 2 * nearness, width=WIDTH, height=HEIGHT
        )


def _placement(sensor: SimulatedSensor, seed: int | None) -> Placement:
    mount = sensor.variation.mount
    return Placement() if mount is None or seed is None else mount.drawn(seed, sensor.name)


def _framed(sensor: SimulatedSensor, signal: CameraSignal, seed: int | None) -> Camera:
    camera, framing = signal.camera(), sensor.variation.framing
    if framing is None or seed is None:
        return camera
    column, row, turn = framing.drawn(seed, sensor.name)
    shift = camera.shift[0] + column, camera.shift[1] + row
    return replace(camera, shift=shift, rotation=camera.rotation + turn)
