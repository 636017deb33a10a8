"""Displacement fields as networks see them, and images moved by them.

Whatever is seen at pixel p of the untouched image is seen at p + d(p) in the frame; components are
(column, row), in pixels of the 640 x 480 image. A field (n, 2, h, w) lies either on a `Lattice`, as
archives keep it, or, without one, at the centres of h x w cells that cover the image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as functional
from torch import Tensor

from learning.errors import LearningError
from recorder.archive import ArchivedSensor
from recorder.archive.array import Rows
from recorder.markers import HEIGHT, WIDTH, Lattice

LATTICE = Lattice()
"""Where archives keep fields, unless they say otherwise."""
FIELD_SIDE = 32
"""Rows and columns of a marker field that a force model sees."""
LEAST_AREA = 0.05
"""Areas are not taken to shrink below this share: markers on a steep flank are seen end-on."""

_STEPS, _COARSE = 8, 4
"""Of the inversion: iterations, and pixels from one place where it is done to the next."""


@dataclass(frozen=True, slots=True, eq=False)
class Fields:
    """Displacement fields of frames."""

    displacement: Tensor
    """(n, 2, h, w) float32 [px]; where nothing is known, from what is around it."""
    known: Tensor
    """(n, h, w) bool: where there is material."""
    lattice: Lattice
    """Where the fields are kept."""


def read_fields(
    sensor: ArchivedSensor, rows: Rows, *, device: torch.device | str = "cpu"
) -> Fields:
    """Return fields of some rows of an archive's sensor.

    Raises:
        SessionError: It keeps none, no such row, or a chunk that is missing or damaged.
    """
    lattice = sensor.lattice
    stored = sensor.displacement(rows).astype(np.float32)
    field = torch.from_numpy(stored).to(device).permute(0, 3, 1, 2).contiguous()
    known = field.isfinite().all(dim=1)
    return Fields(filled(field, known), known, lattice)


def filled(field: Tensor, known: Tensor) -> Tensor:
    """Return fields (n, 2, h, w) with values from what is around them where nothing is known.

    Args:
        field: Anything where it is not known.
        known: (n, h, w) bool. A field that is known nowhere becomes 0.
    """
    there = known.unsqueeze(1).to(field.dtype)
    values = torch.where(known.unsqueeze(1), field, torch.zeros_like(field))
    for _ in range(max(field.shape[-2:])):
        if bool((there.amax(dim=(1, 2, 3)) == there.amin(dim=(1, 2, 3))).all()):
            break
        weight = functional.avg_pool2d(there, 3, 1, 1)
        around = functional.avg_pool2d(values * there, 3, 1, 1) / weight.clamp_min(1e-6)
        new = (there == 0) & (weight > 1e-3)
        values = torch.where(new, around, values)
        there = torch.where(new, torch.ones_like(there), there)
    return values


def sampled(
    field: Tensor, columns: Tensor, rows: Tensor, lattice: Lattice | None = LATTICE
) -> Tensor:
    """Return fields (n, 2, h, w) at places, bilinear, constant beyond their ends: (n, 2, H, W).

    Args:
        field: What is sampled.
        columns: Places (n or 1, H, W) [px of the 640 x 480 image].
        rows: The same.
        lattice: Where the fields are kept; None: cells that cover the image.
    """
    height, width = field.shape[-2:]
    if lattice is None:
        x = (columns + 0.5) * (2 / WIDTH) - 1
        y = (rows + 0.5) * (2 / HEIGHT) - 1
    else:
        if (height, width) != lattice.shape[:2]:
            raise LearningError(
                f"field: found {height} x {width}; allowed: {lattice.shape[0]} x "
                f"{lattice.shape[1]} as its lattice, or lattice None for cells of the image"
            )
        x = (columns + lattice.margin_px) * (2 / lattice.step_px / (width - 1)) - 1
        y = (rows + lattice.margin_px) * (2 / lattice.step_px / (height - 1)) - 1
    places = torch.stack([x, y], dim=-1).expand(len(field), -1, -1, -1)
    return functional.grid_sample(
        field, places, mode="bilinear", padding_mode="border", align_corners=lattice is not None
    )


def inverse(
    field: Tensor,
    shape: tuple[int, int],
    lattice: Lattice | None = LATTICE,
    *,
    steps: int = _STEPS,
    coarse: int = _COARSE,
) -> Tensor:
    """Return e (n, 2, H, W) [px]: what is seen at q in the frame was at q + e(q), untouched.

    It is found by iterating e <- -d(q + e), which converges where the field stretches or shrinks
    lengths by less than their size. Gradients go through the last two iterations: two terms of the
    series of (1 + grad d)^-1.

    Args:
        field: d (n, 2, h, w) [px of the 640 x 480 image].
        shape: Rows and columns of an image of the whole view; q are the centres of its pixels.
        lattice: Where the field is kept; None: cells that cover the image.
        steps: Iterations, 2 or more.
        coarse: It is found at every so many pixels, and between them by interpolation.
    """
    height, width = shape
    places = max(2, -(-height // coarse)), max(2, -(-width // coarse))
    columns, rows = _centres(shape, field, places)
    back = torch.zeros(len(field), 2, *places, device=field.device, dtype=field.dtype)
    with torch.no_grad():
        for _ in range(max(steps, 2) - 2):
            back = -sampled(field, columns + back[:, 0], rows + back[:, 1], lattice)
    for _ in range(2):
        back = -sampled(field, columns + back[:, 0], rows + back[:, 1], lattice)
    return functional.interpolate(back, shape, mode="bilinear", align_corners=True)


def warp(
    reference: Tensor,
    field: Tensor,
    lattice: Lattice | None = LATTICE,
    *,
    steps: int = _STEPS,
    coarse: int = _COARSE,
) -> Tensor:
    """Return the images (n, 1, H, W) that untouched ones become under fields.

    What comes into view from beyond the reference is without markers.

    Args:
        reference: Untouched images (n or 1, 1, H, W) float, of any size, of the whole view.
        field: Displacements (n, 2, h, w) [px of the 640 x 480 image].
        lattice: Where the fields are kept; None: cells that cover the image.
        steps: Iterations of the inversion.
        coarse: The inverse is found at every so many pixels of H x W.
    """
    shape = reference.shape[-2], reference.shape[-1]
    # Coordinates in bfloat16 would be off by pixels.
    with torch.autocast(field.device.type, enabled=False):
        field = field.float()
        back = inverse(field, shape, lattice, steps=steps, coarse=coarse)
        columns, rows = _centres(shape, field)
        x = (columns + back[:, 0] + 0.5) * (2 / WIDTH) - 1
        y = (rows + back[:, 1] + 0.5) * (2 / HEIGHT) - 1
        return functional.grid_sample(
            reference.float().expand(len(field), -1, -1, -1),
            torch.stack([x, y], dim=-1),
            mode="bilinear",
            padding_mode="zeros",
            align_corners=False,
        )


def on_cells(field: Tensor, lattice: Lattice, side: int = FIELD_SIDE) -> Tensor:
    """Return fields on a lattice at the centres of side x side cells of the image: (n, 2, ., .)."""
    columns, rows = _centres((side, side), field)
    return sampled(field, columns, rows, lattice)


def log_area(field: Tensor) -> Tensor:
    """Return the logarithm (n, h, w) of how areas change: of det(1 + grad d).

    Args:
        field: (n, 2, h, w) [px] at the centres of cells that cover the image.
    """
    height, width = field.shape[-2:]
    down, across = torch.gradient(field, dim=(2, 3))
    across, down = across * (width / WIDTH), down * (height / HEIGHT)
    area = (1 + across[:, 0]) * (1 + down[:, 1]) - across[:, 1] * down[:, 0]
    return area.clamp_min(LEAST_AREA).log()


def marker_maps(fields: Fields, side: int = FIELD_SIDE) -> Tensor:
    """Return what a force model sees of fields (n, 3, side, side): dx, dy [px], log area change."""
    cells = on_cells(fields.displacement, fields.lattice, side)
    return torch.cat([cells, log_area(cells).unsqueeze(1)], dim=1)


def _centres(
    shape: tuple[int, int], like: Tensor, places: tuple[int, int] | None = None
) -> tuple[Tensor, Tensor]:
    """Return columns and rows (1, h, w) [px of 640 x 480] from the first pixel to the last.

    Args:
        shape: Rows and columns of an image of the whole view.
        like: Has the device and the type that are wanted.
        places: How many, evenly between the outermost; None: one a pixel.
    """

    def along(pixels: int, side: int, count: int) -> Tensor:
        first = side / pixels / 2 - 0.5
        return torch.linspace(first, side - 1 - first, count, device=like.device, dtype=like.dtype)

    height, width = places or shape
    rows, columns = torch.meshgrid(
        along(shape[0], HEIGHT, height), along(shape[1], WIDTH, width), indexing="ij"
    )
    return columns.unsqueeze(0), rows.unsqueeze(0)
