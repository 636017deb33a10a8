"""Pictures with known markers, and the accuracy of marker detection on them.

Run it with `python tests/support/marker_truth.py`.

The mock bench's camera draws discs at known positions; the simulator's GelSight is lit by coloured
lamps and comes with the mask that was rendered.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from support.dot_camera import MarkerCamera, MarkerView, PressedSurface

from learning.markers import CameraPreset, Segmenter, preset
from recorder.markers import SMALLEST_PX, find_blobs, marker_centres
from sim.layer import Layer

# Views of the mock benches, by the preset intended for them.
VIEWS = {
    "bench-gelsight": MarkerView("grid", 1.6e-3, 0.26e-3, 0.0249e-3, rows=7, columns=9),
    "bench-tacpalm": MarkerView(
        "hexagon", 2.6e-3, 0.55e-3, 0.075e-3, background=(92, 96, 104), ink=(226, 228, 222)
    ),
}


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """One picture with its ground truth."""

    picture: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    centres: NDArray[np.float64]
    """Column and row (n, 2) of the markers inside the picture [px]."""


@dataclass(frozen=True, slots=True)
class Found:
    """Accuracy of marker detection on some pictures."""

    iou: float
    """Smallest overlap of masks."""
    rms_px: float
    """RMS error of centres."""
    worst_px: float
    """Largest error of centres."""
    missed: int
    """Markers without a centre within 5 px, and centres without a marker."""
    rate: float
    """Masks per second of CPU time, the best of three."""


def mock_pictures(view: MarkerView, *, grey_noise: float, frames: int = 6) -> Iterator[Known]:
    """Yield pictures of a press with increasing depth and shear."""
    camera = MarkerCamera(view, grey_noise=grey_noise, seed=3)
    stencil = MarkerCamera(replace(view, background=(0, 0, 0), ink=(255, 255, 255)))
    depth = 1.2e-3 if view.layout == "grid" else 4.0e-3
    radius_px = view.radius / view.pixel
    for fraction in np.linspace(0, 1, frames):
        surface = PressedSurface(
            (1e-3, -0.5e-3), depth * fraction, 3e-3, 4e-3, (0.4e-3 * fraction, 0.2e-3 * fraction)
        )
        centres = camera.pixels(surface)
        # The drawn disc is half a pixel wider than specified; the ground truth is the drawn one.
        drawn = stencil.image(surface).min(axis=2) >= 128
        inset = np.minimum(centres, [639, 479] - centres).min(axis=1)
        yield Known(camera.image(surface), drawn, centres[inset > radius_px + 3])


def simulated_pictures() -> Iterator[Known]:
    """Yield coloured pictures of the simulator's GelSight under a sphere."""
    from sim import press, simulate
    from sim.indenters import named
    from sim.sensors import CameraReadout, SurfaceField, readout, sensor
    from tests.support.colour import pictures

    each = sensor("gelsight")
    motion = press([0.3e-3, 0.6e-3, 1.0e-3], speed=each.speed)
    top = SurfaceField.of(simulate(each.scene(named("sphere"), motion), Layer()))
    reader = readout(each)
    if not isinstance(reader, CameraReadout):
        raise TypeError("the GelSight has a camera")
    masks = reader.masks(top)[:, 0]
    for picture, mask in zip(pictures(each, reader, top), masks, strict=True):
        truth = find_blobs(mask[None], SMALLEST_PX)
        yield Known(picture, mask, truth.centre[truth.whole])


def measure(known: list[Known], name: str) -> Found:
    """Return the accuracy of a preset on pictures."""
    found = preset(name)
    if not isinstance(found, CameraPreset):
        raise TypeError(f"{name} is not for pictures")
    segmenter = Segmenter(found)
    cv2.setNumThreads(1)
    ious, errors, missed = [], [], 0
    for one in known:
        mask = segmenter.mask(one.picture)
        ious.append(np.sum(mask & one.mask) / np.sum(mask | one.mask))
        centres = marker_centres(mask)
        apart = np.linalg.norm(one.centres[:, None] - centres[None], axis=-1)
        near = apart.min(axis=1)
        errors += near[near < 5].tolist()
        inset = np.minimum(centres, [639, 479] - centres).min(axis=1)
        missed += int(np.sum(near >= 5)) + int(np.sum((apart.min(axis=0) >= 5) & (inset > 25)))
    spent = []
    for _ in range(3):
        began = time.process_time()
        for one in known:
            segmenter.mask(one.picture)
        spent.append((time.process_time() - began) / len(known))
    rms = float(np.sqrt(np.mean(np.square(errors))))
    return Found(min(ious), rms, max(errors), missed, 1 / max(min(spent), 1e-9))


def main() -> None:
    """Print the accuracy of every preset on the pictures that it could be meant for."""
    print(f"{'pictures':32s}{'preset':18s}{'IoU':>7s}{'centre':>8s}{'worst':>8s} missed")
    cases = [
        (f"{name}, noise {noise:g}", name, list(mock_pictures(view, grey_noise=noise)))
        for name, view in VIEWS.items()
        for noise in (1.0, 4.0)
    ]
    lit = list(simulated_pictures())
    cases += [
        ("bench-gelsight, noise 1", name, cases[0][2]) for name in ("gelsight", "gelsight-white")
    ]
    cases += [
        ("simulated GelSight in colour", name, lit)
        for name in ("bench-gelsight", "gelsight", "gelsight-white")
    ]
    for title, name, known in cases:
        found = measure(known, name)
        print(
            f"{title:32s}{name:18s}{found.iou:7.3f}{found.rms_px:8.3f}"
            f"{found.worst_px:8.3f}{found.missed:5d}"
            f"   {found.rate:5.0f} masks/s"
        )


if __name__ == "__main__":
    main()
