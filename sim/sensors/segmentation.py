"""What segmentation does to markers: edges that waver, markers that it misses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label

from sim.checks import check_range
from sim.errors import SceneError
from sim.sensors.seeds import generator

Masks = NDArray[np.bool_]
Greys = NDArray[np.uint8]
Floats = NDArray[np.float32]
Indices = NDArray[np.int64]

WHITE = 255
"""Grey of a pixel that a marker covers wholly."""
JITTER_MAX = 1.0
"""Largest jitter [px]: edges are followed for 2.5 px either way, beyond that they stay."""
PROFILE = (
    np.array([-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]),
    np.array([0.0, 1.0, 5.0, 11.0, 15.0, 16.0]) / 16,
)
"""Grey across a straight edge that is softened by 1 4 6 4 1, linear in between: distance inside the
edge [px], and share of white. It rounds a marker of radius r by 1 / (2 r)."""
BANK = (768, 1024)
"""Size of the field of noise that every frame takes a window of [px]: a new one each frame would
cost more than all the rest."""


@dataclass(frozen=True, slots=True)
class Segmentation:
    """How far segmented markers are from those drawn.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    jitter_px: float = 0.0
    """Standard deviation of an edge's place along its normal, 0 to 1."""
    correlation_px: float = 4.0
    """How far along an edge the jitter hangs together, as the spread of a Gaussian, 0.5 to 50."""
    missing: float = 0.0
    """Share of markers that a frame misses, each frame anew, 0 to 1."""
    rim_px: float = 0.0
    """Width of the dark rim of the image, 0 to 200."""
    rim_missing: float = 0.0
    """Share of markers that are missed of those which reach into the rim, 0 to 1."""

    def __post_init__(self) -> None:
        for name, low, high, unit in (
            ("jitter_px", 0.0, JITTER_MAX, "px"),
            ("correlation_px", 0.5, 50.0, "px"),
            ("missing", 0.0, 1.0, ""),
            ("rim_px", 0.0, 200.0, "px"),
            ("rim_missing", 0.0, 1.0, ""),
        ):
            check_range("segmentation", name, getattr(self, name), low, high, unit=unit)


class Segmenter:
    """Applies a `Segmentation` to images of one sensor; frame k has the same errors every time.

    Args:
        segmentation: How large the errors are.
        seed: Of all draws.
        names: What tells these images from others, such as sensor and indenter.
    """

    def __init__(self, segmentation: Segmentation, seed: int, *names: str | int) -> None:
        self._segmentation = segmentation
        self._seed, self._names = seed, names
        self._bank = np.zeros((0, 0), np.float32)
        if segmentation.jitter_px > 0:
            white = generator(seed, "segmentation", *names).normal(size=BANK)
            smooth = gaussian_filter(white, segmentation.correlation_px, mode="wrap")
            self._bank = (smooth / smooth.std()).astype(np.float32)

    def seen(self, coverage: Greys, first: int = 0) -> Masks:
        """Masks (F, H, W) of what is found in grey images of markers (F, H, W), 255 covered wholly.

        Args:
            coverage: How much of each pixel markers cover. From a mask (0 or 255) a jitter below
                half a pixel is lost: where the edge runs within the pixel is not in it.
            first: Number of the first frame; it picks the errors.

        Raises:
            SceneError: Not grey images.
        """
        if coverage.dtype != np.uint8 or coverage.ndim != 3:
            raise SceneError(
                f"coverage: {coverage.dtype} of shape {coverage.shape}; allowed: uint8 (frames, "
                "rows, columns)"
            )
        found = np.empty(coverage.shape, bool)
        for index, image in enumerate(coverage):
            random = generator(self._seed, "segmentation", *self._names, first + index)
            found[index] = self._kept(self._wavered(image, random), random)
        return found

    def _wavered(self, image: Greys, random: np.random.Generator) -> Masks:
        """The mask whose edges are moved along their normals.

        At the distance d inside an edge the softened image has the grey `PROFILE` of d, so the
        grey of n as the threshold finds the edge n further in.
        """
        jitter = self._segmentation.jitter_px
        if jitter == 0:
            return image >= WHITE / 2
        soft = softened(image)
        whole = 256 * WHITE
        found = soft > whole // 2
        edges = np.flatnonzero((soft > 0) & (soft < whole))
        inward = jitter * self._noise(edges, image.shape[1], random)
        threshold = whole * np.interp(inward, *PROFILE)
        found.flat[edges] = soft.flat[edges] > threshold
        return found

    def _noise(self, pixels: Indices, width: int, random: np.random.Generator) -> Floats:
        """Noise (n,) at pixels of an image, from a window anywhere in the bank, mirrored or not."""
        top, left = random.integers(0, BANK)
        flips = 1 - 2 * random.integers(0, 2, 2)
        row = (top + flips[0] * (pixels // width)) % BANK[0]
        column = (left + flips[1] * (pixels % width)) % BANK[1]
        noise: Floats = self._bank[row, column]
        return noise

    def _kept(self, mask: Masks, random: np.random.Generator) -> Masks:
        """The mask without the markers that are missed."""
        chosen = self._segmentation
        rim = round(chosen.rim_px)
        dim = chosen.rim_missing > 0 and rim > 0
        if chosen.missing == 0 and not dim:
            return mask
        markers, count = label(mask)
        lost = np.zeros(count + 1, bool)
        lost[1:] = random.random(count) < chosen.missing
        if dim:
            reaching = np.zeros(count + 1, bool)
            for strip in (markers[:rim], markers[-rim:], markers[:, :rim], markers[:, -rim:]):
                reaching[strip.ravel()] = True
            lost[1:] |= reaching[1:] & (random.random(count) < chosen.rim_missing)
        if not lost.any():
            return mask
        kept: Masks = mask & ~lost[markers]
        return kept


def softened(image: Greys) -> NDArray[np.uint16]:
    """An image (H, W) times 256, softened by 1 4 6 4 1 along rows and columns; borders go on.

    The weights are those of a Gaussian of 1 px as closely as five can be: four times the sum of
    neighbours, along each axis.
    """
    soft = np.pad(image.astype(np.uint16), 2, mode="edge")
    for _ in range(4):
        soft = soft[1:] + soft[:-1]
    for _ in range(4):
        soft = soft[:, 1:] + soft[:, :-1]
    return soft
