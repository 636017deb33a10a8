# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""From the material map to images: which pixels, or which share of each, a marker covers.

A straight edge covers half of a pixel exactly when the pixel's centre lies on it. So a pixel is
marker (at least half of it) where the signed distance at its centre is not above 0: anti-aliased,
then thresholded, to first order in the size of a pixel. Several samples a pixel count the share
that is covered instead; bent edges and corners are then as exact as the samples are fine.
"""

import functools

import warp as wp

from sim.camera import HEIGHT, WIDTH
from sim.render.textures import Textures

BITS = 8
"""Pixels in a byte of a packed mask."""
FLAT = 1e-12
"""Change of the distance from pixel to pixel below which there is no edge [m]."""


@wp.func
def distance_at(
    values: wp.array3d[float], pattern: int, corner: wp.vec2, density: float, place: wp.vec2
):
    """Signed distance to a marker's edge [m] at a material point; far from all where NaN.

    `density` is the number of values a metre.
    """
    if wp.isnan(place[0]):
        return wp.inf
    last_row = values.shape[1] - 1
    last_column = values.shape[2] - 1
    x = wp.clamp((place[0] - corner[0]) * density, 0.0, float(last_column))
    y = wp.clamp((place[1] - corner[1]) * density, 0.0, float(last_row))
    column = wp.min(int(x), last_column - 1)
    row = wp.min(int(y), last_row - 1)
    right = x - float(column)
    up = y - float(row)
    low = wp.lerp(values[pattern, row, column], values[pattern, row, column + 1], right)
    high = wp.lerp(values[pattern, row + 1, column], values[pattern, row + 1, column + 1], right)
    return wp.lerp(low, high, up)


@wp.func
def covered(
    material: wp.array3d[wp.vec2],
    frame: int,
    row: int,
    column: int,
    samples: int,
    values: wp.array3d[float],
    pattern: int,
    corner: wp.vec2,
    density: float,
):
    """How many of a pixel's samples a marker covers."""
    count = wp.int32(0)
    for r in range(samples):
        for c in range(samples):
            place = material[frame, row * samples + r, column * samples + c]
            if distance_at(values, pattern, corner, density, place) <= 0.0:
                count += 1
    return count


@functools.cache
def _mask_kernel(several: bool):
    @wp.kernel(enable_backward=False, module="unique")
    def pack(
        # Settings:
        samples: int,
        corner: wp.vec2,
        density: float,
        # In:
        values: wp.array3d[float],
        material: wp.array3d[wp.vec2],
        # Out: eight pixels a byte, the first in the highest bit
        packed_out: wp.array3d[wp.uint8],
    ):
        frame, pattern, byte = wp.tid()
        row = byte * BITS // WIDTH
        first = byte * BITS % WIDTH
        bits = wp.int32(0)
        if wp.static(not several):
            middle = material[frame, row, first + BITS // 2]
            far = distance_at(values, pattern, corner, density, middle)
            for k in range(BITS):
                place = material[frame, row, first + k]
                here = far
                # Bilinear between distances, it changes by sqrt 2 times the way at most.
                if not 2.0 * wp.length_sq(place - middle) < far * far:
                    here = distance_at(values, pattern, corner, density, place)
                bits = 2 * bits + wp.where(here <= 0.0, 1, 0)
        else:
            for k in range(BITS):
                count = covered(
                    material, frame, row, first + k, samples, values, pattern, corner, density
                )
                bits = 2 * bits + wp.where(2 * count >= samples * samples, 1, 0)
        packed_out[frame, pattern, byte] = wp.uint8(bits)

    return pack


def packed_masks(material, samples: int, textures: Textures) -> wp.array:
    """Packed masks (F, P, H W / 8) uint8 of every frame and pattern."""
    shape = (material.shape[0], len(textures), HEIGHT * WIDTH // BITS)
    packed = wp.empty(shape, dtype=wp.uint8, device=material.device)
    wp.launch(
        _mask_kernel(samples > 1),
        dim=shape,
        inputs=[samples, textures.corner, 1.0 / textures.step, textures.values, material],
        outputs=[packed],
        device=material.device,
    )
    return packed


@wp.func
def distance_beside(
    material: wp.array3d[wp.vec2],
    frame: int,
    row: int,
    column: int,
    values: wp.array3d[float],
    pattern: int,
    corner: wp.vec2,
    density: float,
    instead: float,
):
    """Distance at a pixel; `instead` where there is no pixel or it sees no gel."""
    if row < 0 or row >= material.shape[1] or column < 0 or column >= material.shape[2]:
        return instead
    place = material[frame, row, column]
    if wp.isnan(place[0]):
        return instead
    return distance_at(values, pattern, corner, density, place)


@functools.cache
def _coverage_kernel(several: bool):
    @wp.kernel(enable_backward=False, module="unique")
    def cover(
        # Settings:
        samples: int,
        corner: wp.vec2,
        density: float,
        # In:
        values: wp.array3d[float],
        material: wp.array3d[wp.vec2],
        # Out: 255 where all of a pixel is marker
        coverage_out: wp.array4d[wp.uint8],
    ):
        frame, pattern, row, column = wp.tid()
        share = wp.float32(0.0)
        if wp.static(several):
            count = covered(material, frame, row, column, samples, values, pattern, corner, density)
            share = float(count) / float(samples * samples)
        else:
            here = distance_at(values, pattern, corner, density, material[frame, row, column])
            if wp.isfinite(here):
                left = distance_beside(
                    material, frame, row, column - 1, values, pattern, corner, density, here
                )
                right = distance_beside(
                    material, frame, row, column + 1, values, pattern, corner, density, here
                )
                above = distance_beside(
                    material, frame, row - 1, column, values, pattern, corner, density, here
                )
                below = distance_beside(
                    material, frame, row + 1, column, values, pattern, corner, density, here
                )
                change = wp.length(wp.vec2(right - left, below - above)) * 0.5
                share = wp.where(here <= 0.0, 1.0, 0.0)
                if change > FLAT:
                    share = wp.clamp(0.5 - here / change, 0.0, 1.0)
        coverage_out[frame, pattern, row, column] = wp.uint8(share * 255.0 + 0.5)

    return cover


def coverages(material, samples: int, textures: Textures) -> wp.array:
    """Share of each pixel that markers cover (F, P, H, W) uint8, 255 for all of it."""
    shape = (material.shape[0], len(textures), HEIGHT, WIDTH)
    coverage = wp.empty(shape, dtype=wp.uint8, device=material.device)
    wp.launch(
        _coverage_kernel(samples > 1),
        dim=shape,
        inputs=[samples, textures.corner, 1.0 / textures.step, textures.values, material],
        outputs=[coverage],
        device=material.device,
    )
    return coverage
