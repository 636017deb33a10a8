"""Marker image of a uSkin: one disc per taxel, which moves with shear and grows with pressure.

Taxel i is at (i % 4, i // 4) on axes that run from -1 to 4 over the image, y **up**: taxel 0 is
at the lower left, and a positive y count moves its disc towards smaller rows. Sizes are those of a
scatter plot, in square typographic points at 100 dots per inch (1 point = 1/72 inch).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.markers.masks import HEIGHT, WIDTH, Masks

Array = NDArray[np.float64]

TAXELS, SIDE = 16, 4
_POINTS_PER_INCH, _DOTS_PER_INCH = 72.0, 100.0
# Limits of the axes, at the left and at the bottom, and at the right and at the top [pitch].
_AXIS_MIN, _AXIS_MAX = -1.0, 4.0
# A pixel is set if the disc covers more than this fraction: grey above 50 of 255.
_LEAST_COVERAGE = 50 / 255
_BLOCK = 64  # frames drawn at once, so that their rims stay in the cache


@dataclass(frozen=True, slots=True)
class DiscMap:
    """Map from counts to discs. Defaults: the paper's Methods and the authors' publisher."""

    shear_per_count: float = 2e-4
    """S_X = S_Y: shift of a disc per count of x or y [pitch]."""
    size_per_count: float = 0.2
    """S_D: growth of a disc per count of z [points^2]."""
    size_min: float = 300.0
    """Size of a disc without contact, and the minimum [points^2]: 24.06 px in diameter."""
    size_max: float = 6000.0
    """Maximum size [points^2]: 107.6 px in diameter."""
    shift_max: float = 0.6
    """Largest shift of a disc along either axis [pitch]."""
    centre_min: float = -0.6
    """Lower limit of a centre's coordinates [pitch]."""
    centre_max: float = 3.6
    """Upper limit of a centre's coordinates [pitch]."""

    def __post_init__(self) -> None:
        for low, high in (("size_min", "size_max"), ("centre_min", "centre_max")):
            if not getattr(self, low) < getattr(self, high):
                raise ValueError(
                    f"{low}: found {getattr(self, low)}; allowed: less than {high}, "
                    f"{getattr(self, high)}"
                )
        if not self.size_min > 0:
            raise ValueError(f"size_min: found {self.size_min}; allowed: more than 0")
        if not self.shift_max >= 0:
            raise ValueError(f"shift_max: found {self.shift_max}; allowed: 0 or more")


# Map used in the paper.
PAPER = DiscMap()


def draw_discs(counts: NDArray[np.integer | np.floating], disc_map: DiscMap = PAPER) -> Masks:
    """Return the marker images (..., 480, 640) of x, y, z of the 16 taxels (..., 16, 3) [counts].

    They are relative to no contact.

    Raises:
        ValueError: A different shape, or counts that are not finite.
    """
    centre, radius = place_discs(counts, disc_map)
    lead = radius.shape[:-1]
    centre, radius = centre.reshape(-1, TAXELS, 2), radius.reshape(-1, TAXELS)
    masks = np.zeros((len(radius), HEIGHT, WIDTH), np.bool_)
    for first in range(0, len(radius), _BLOCK):
        block = slice(first, first + _BLOCK)
        _fill(masks[block], centre[block], radius[block])
    return masks.reshape(*lead, HEIGHT, WIDTH)


def place_discs(
    counts: NDArray[np.integer | np.floating], disc_map: DiscMap = PAPER
) -> tuple[Array, Array]:
    """Return centres (..., 16, 2) as column and row, and radii (..., 16) of the discs [px].

    Counts are as for `draw_discs`.

    Raises:
        ValueError: A different shape, or counts that are not finite.
    """
    counts = np.asarray(counts, np.float64)
    if counts.shape[-2:] != (TAXELS, 3):
        raise ValueError(f"counts: found shape {counts.shape}; expected (..., {TAXELS}, 3)")
    if not np.isfinite(counts).all():
        raise ValueError("counts: found NaN or infinity; allowed: finite counts")
    taxel = np.arange(TAXELS)
    home = np.stack([taxel % SIDE, taxel // SIDE], axis=-1)
    limit = disc_map.shift_max
    shift = np.clip(counts[..., :2] * disc_map.shear_per_count, -limit, limit)
    position = np.clip(home + shift, disc_map.centre_min, disc_map.centre_max)
    fraction = (position - _AXIS_MIN) / (_AXIS_MAX - _AXIS_MIN)
    centre = np.stack([fraction[..., 0] * WIDTH, (1.0 - fraction[..., 1]) * HEIGHT], axis=-1)
    grown = disc_map.size_min + disc_map.size_per_count * counts[..., 2]
    size = np.clip(grown, disc_map.size_min, disc_map.size_max)
    radius = 0.5 * np.sqrt(size) * _DOTS_PER_INCH / _POINTS_PER_INCH
    return centre, radius


def _fill(masks: Masks, centre: Array, radius: Array) -> None:
    """Set the pixels of masks (n, 480, 640) that discs cover; only rows with discs are touched."""
    reach = int(np.ceil(radius.max())) + 1
    row = np.floor(centre[..., 1, None]) + np.arange(-reach, reach + 2)
    half = _half_chord(radius[..., None], row - centre[..., 1, None])
    left = np.clip(np.ceil(centre[..., 0, None] - half), 0, WIDTH)
    right = np.clip(np.floor(centre[..., 0, None] + half) + 1, 0, WIDTH)
    drawn = (half >= 0) & (row >= 0) & (row < HEIGHT) & (right > left)
    frame = np.broadcast_to(np.arange(len(masks))[:, None, None], drawn.shape)[drawn]
    line = frame * HEIGHT + row[drawn].astype(np.int64)
    used = np.zeros(len(masks) * HEIGHT, np.bool_)
    used[line] = True
    used_row = np.cumsum(used)[line] - 1
    # Discs open and close runs; a pixel is set where more were opened than closed up to it.
    steps = np.zeros((np.count_nonzero(used), WIDTH + 1), np.int8)
    np.add.at(steps, (used_row, left[drawn].astype(np.int64)), 1)
    np.add.at(steps, (used_row, right[drawn].astype(np.int64)), -1)
    np.cumsum(steps, axis=1, dtype=np.int8, out=steps)
    masks.reshape(-1, WIDTH)[used] = steps[:, :WIDTH] > 0


def _half_chord(radius: Array, across: Array) -> Array:
    """Return the half-width over which a row of pixels is covered [px]; negative if not covered.

    The row of pixel centres is `across` from the centre of a disc of `radius` [px]. The edge that
    cuts a rim pixel is straight up to 1 / (24 radius) of its area. The direction of that edge
    depends on its position in the row, so the end is found by iteration.
    """
    half = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
    for _ in range(3):
        square = (radius + _beyond_edge(half, across)) ** 2 - across**2
        half = np.sqrt(np.maximum(square, 0.0))
    return np.where(square >= 0, half, -1.0)


def _beyond_edge(along: Array, across: Array) -> Array:
    """Return the distance outside a straight edge of the centre of a just covered pixel [px].

    The edge is normal to (along, across). It cuts off a triangle of the unit square if it passes
    one corner, and a trapezium if it passes two.
    """
    fraction = _LEAST_COVERAGE
    along, across = np.abs(along), np.abs(across)
    length = np.maximum(np.hypot(along, across), 1e-9)
    long, short = np.maximum(along, across) / length, np.minimum(along, across) / length
    triangle = 0.5 * (long + short) - np.sqrt(2.0 * long * short * fraction)
    return np.where(2.0 * fraction * long >= short, long * (0.5 - fraction), triangle)
