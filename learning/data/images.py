"""Network images: 256 x 256, one channel, anti-aliased; conversion from masks and back.

Shrinking takes the exact mean over 2.5 columns and 1.875 rows, which preserves the subpixel
position of marker edges. Enlarging follows the authors' inference: Lanczos to 640 x 480, then a
threshold of 128. Tensors may be on a GPU; packed masks are shrunk as arrays.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import torch.nn.functional as functional
from numpy.typing import NDArray
from torch import Tensor

from learning.errors import LearningError
from recorder.archive import ArchivedSensor, Rows
from recorder.markers import HEIGHT, WIDTH, Lattice, unpack

# Rows and columns of an image [px].
SIDE = 256
# Grey level above which an enlarged pixel belongs to a marker (authors' code).
ABOVE = 128

# Images processed at once: unpacked they take 20 MB.
_AT_ONCE = 64
# 15 rows become 8, and 5 columns become 2.
_ROWS, _COLUMNS = 15, 5
# Sum of the weights of one pixel: 15 eighths of rows by 5 halves of columns.
_WHOLE = 75
# Pillow's Lanczos kernel: zeros on each side, and bits of its weights.
_LOBES, _BITS = 3, 22


def unit(images: Tensor) -> Tensor:
    """Return images (n, h, w) uint8 as (n, 1, h, w) float32 in 0 to 1."""
    return images.unsqueeze(1).float() / 255


def shrink(packed: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Shrink packed masks (n, 38400) to images (n, 256, 256); 255 is a pixel full of marker."""
    images = np.empty((len(packed), SIDE, SIDE), np.uint8)
    for first in range(0, len(packed), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        masks = unpack(packed[part]).view(np.uint8)
        images[part] = _grey_levels()[_summed(masks, np.stack)]
    return images


def shrink_masks(masks: Tensor) -> Tensor:
    """Shrink masks (n, 480, 640) bool to images (n, 256, 256) uint8, as `shrink` does."""
    images = torch.empty((len(masks), SIDE, SIDE), dtype=torch.uint8, device=masks.device)
    levels = torch.from_numpy(_grey_levels()).to(masks.device)
    for first in range(0, len(masks), _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        images[part] = levels[_summed(masks[part].view(torch.uint8), torch.stack).int()]
    return images


def enlarge_images(images: Tensor) -> Tensor:
    """Enlarge images (n, 256, 256) uint8 to masks (n, 480, 640) bool.

    The result is that of Pillow's Lanczos with the authors' threshold of 128, except for pixels
    within rounding of the threshold.
    """
    masks = torch.empty((len(images), HEIGHT, WIDTH), dtype=torch.bool, device=images.device)
    across, down = (
        torch.from_numpy(_lanczos(side)).to(images.device, torch.float32)
        for side in (WIDTH, HEIGHT)
    )
    # Weights in bfloat16 would move edges.
    with torch.autocast(images.device.type, enabled=False):
        for first in range(0, len(images), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            # Pillow rounds to grey levels between its two passes, columns first.
            wide = (images[part].float() @ across.T).round_().clamp_(0, 255)
            masks[part] = (down @ wide).round_() > ABOVE
    return masks


def unpack_masks(packed: Tensor) -> Tensor:
    """Unpack masks (n, 38400) uint8 to (n, 480, 640) bool, on their device."""
    masks = torch.tensor([128, 64, 32, 16, 8, 4, 2, 1], dtype=torch.uint8, device=packed.device)
    bits = packed.unsqueeze(-1) & masks
    return (bits != 0).view(len(packed), HEIGHT, WIDTH)


def _summed(masks: Any, stack: Callable[..., Any]) -> Any:
    """Return weighted sums (n, 256, 256), 0 to 75, of masks (n, 480, 640) uint8 of 0 and 1."""
    blocks = masks.reshape(len(masks), -1, _ROWS, WIDTH)
    rows = []
    for each in range(8):
        total = None
        for row in range(_ROWS * each // 8, -(-_ROWS * (each + 1) // 8)):
            # Eighths of this row between 15/8 each and 15/8 (each + 1).
            weight = min(8 * row + 8, _ROWS * (each + 1)) - max(8 * row, _ROWS * each)
            part = blocks[:, :, row] * weight
            total = part if total is None else total + part
        rows.append(total)
    high = stack(rows, 2).reshape(len(masks), SIDE, SIDE // 2, _COLUMNS)
    middle = high[..., 2]
    left = 2 * (high[..., 0] + high[..., 1]) + middle
    right = 2 * (high[..., 3] + high[..., 4]) + middle
    return stack([left, right], 3).reshape(len(masks), SIDE, SIDE)


@functools.cache
def _grey_levels() -> NDArray[np.uint8]:
    """Return the grey level of each weighted sum."""
    return np.round(np.arange(_WHOLE + 1) * (255 / _WHOLE)).astype(np.uint8)


@functools.cache
def _lanczos(side: int) -> NDArray[np.float64]:
    """Return Pillow's weights (side, 256) for resizing 256 pixels to a larger side."""
    scale = SIDE / side
    centres = (np.arange(side) + 0.5) * scale
    first = np.maximum((centres - _LOBES + 0.5).astype(int), 0)
    end = np.minimum((centres + _LOBES + 0.5).astype(int), SIDE)
    pixels = np.arange(SIDE)
    distance = pixels[None, :] + 0.5 - centres[:, None]
    weights = np.sinc(distance) * np.sinc(distance / _LOBES)
    inside = (pixels >= first[:, None]) & (pixels < end[:, None]) & (np.abs(distance) < _LOBES)
    weights = np.where(inside, weights, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    return np.asarray(np.round(weights * 2**_BITS) / 2**_BITS)


# Displacement fields on the lattice of archives, and images warped by them.
#
# A point at pixel p of the image without contact is at p + d(p) in the frame; components
# are (column, row), in pixels of the 640 x 480 image.

# Default lattice of fields in archives.
LATTICE = Lattice()

# Inversion: number of iterations, and step of the coarse grid [px].
_STEPS, _COARSE = 8, 4


def read_fields(
    sensor: ArchivedSensor, rows: Rows, *, device: torch.device | str = "cpu"
) -> tuple[Tensor, Tensor]:
    """Return fields of some rows of an archive's sensor, and where there is material.

    The fields are (n, 2, h, w) float32 [px] on the sensor's lattice, undefined values filled from
    their surroundings; the second is (n, h, w) bool.
    """
    stored = sensor.displacement(rows).astype(np.float32)
    field = torch.from_numpy(stored).to(device).permute(0, 3, 1, 2).contiguous()
    defined = field.isfinite().all(dim=1)
    return filled(field, defined), defined


def filled(field: Tensor, defined: Tensor) -> Tensor:
    """Fill undefined values of fields (n, 2, h, w) from their surroundings; without any it is 0."""
    there = defined.unsqueeze(1).to(field.dtype)
    values = torch.where(defined.unsqueeze(1), field, torch.zeros_like(field))
    for _ in range(max(field.shape[-2:])):
        if bool((there.amax(dim=(1, 2, 3)) == there.amin(dim=(1, 2, 3))).all()):
            break
        weight = functional.avg_pool2d(there, 3, 1, 1)
        around = functional.avg_pool2d(values * there, 3, 1, 1) / weight.clamp_min(1e-6)
        new = (there == 0) & (weight > 1e-3)
        values = torch.where(new, around, values)
        there = torch.where(new, torch.ones_like(there), there)
    return values


def sampled(field: Tensor, columns: Tensor, rows: Tensor, lattice: Lattice = LATTICE) -> Tensor:
    """Sample fields (n, 2, h, w) bilinearly, constant beyond their borders: (n, 2, H, W).

    Columns and rows of the sample points are (n or 1, H, W) [px of the 640 x 480 image].
    """
    height, width = field.shape[-2:]
    if (height, width) != lattice.shape[:2]:
        raise LearningError(
            f"field: found {height} x {width}; allowed: {lattice.shape[0]} x {lattice.shape[1]} "
            "as its lattice"
        )
    x = (columns + lattice.margin_px) * (2 / lattice.step_px / (width - 1)) - 1
    y = (rows + lattice.margin_px) * (2 / lattice.step_px / (height - 1)) - 1
    grid = torch.stack([x, y], dim=-1).expand(len(field), -1, -1, -1)
    return functional.grid_sample(
        field, grid, mode="bilinear", padding_mode="border", align_corners=True
    )


def inverse(
    field: Tensor, columns: Tensor, rows: Tensor, lattice: Lattice = LATTICE, steps: int = _STEPS
) -> Tensor:
    """Return e (n, 2, H, W) [px]: a point at q in the frame was at q + e before contact.

    It is the fixed point of e <- -d(q + e), of a field d (n, 2, h, w) [px] at points q, whose
    columns and rows are ((1,) H, W) [px of the 640 x 480 image]. The iteration converges if the
    field stretches or shrinks lengths by less than 100 %.
    """
    back = field.new_zeros(len(field), 2, *columns.shape[-2:])
    for _ in range(steps):
        back = -sampled(field, columns + back[:, 0], rows + back[:, 1], lattice)
    return back


def warp(reference: Tensor, field: Tensor, lattice: Lattice = LATTICE) -> Tensor:
    """Warp images without contact by fields (n, 2, h, w) [px of 640 x 480]: (n, 1, H, W).

    The images (n or 1, 1, H, W) are of any size and show the whole view. Areas that enter it from
    outside of the reference have no markers.
    """
    shape = reference.shape[-2], reference.shape[-1]
    few = max(2, -(-shape[0] // _COARSE)), max(2, -(-shape[1] // _COARSE))
    # In bfloat16, coordinates would be off by pixels.
    with torch.autocast(field.device.type, enabled=False):
        field = field.float()
        coarse = inverse(field, *_centres(shape, field, few), lattice)
        back = functional.interpolate(coarse, shape, mode="bilinear", align_corners=True)
        columns, rows = _centres(shape, field, shape)
        x = (columns + back[:, 0] + 0.5) * (2 / WIDTH) - 1
        y = (rows + back[:, 1] + 0.5) * (2 / HEIGHT) - 1
        return functional.grid_sample(
            reference.float().expand(len(field), -1, -1, -1),
            torch.stack([x, y], dim=-1),
            mode="bilinear",
            padding_mode="zeros",
            align_corners=False,
        )


def _centres(
    shape: tuple[int, int], like: Tensor, places: tuple[int, int]
) -> tuple[Tensor, Tensor]:
    """Return columns and rows (1, h, w) [px of 640 x 480] from the first pixel to the last.

    The image of the whole view has `shape`; `places` are the numbers of evenly spaced rows and
    columns. Device and dtype are those of `like`.
    """

    def along(pixels: int, side: int, count: int) -> Tensor:
        first = side / pixels / 2 - 0.5
        return torch.linspace(first, side - 1 - first, count, device=like.device, dtype=like.dtype)

    rows, columns = torch.meshgrid(
        along(shape[0], HEIGHT, places[0]), along(shape[1], WIDTH, places[1]), indexing="ij"
    )
    return columns.unsqueeze(0), rows.unsqueeze(0)
