"""Deformations as the networks know them, and how they move a reference.

A deformation is (n, 3, h, w) on cells that tile the 640 x 480 image evenly, cell centres like the
pixel centres of an image of h rows and w columns:

- channels 0 and 1: shift (column, row) [px]. What is seen at p in the frame was, untouched, seen
  at p - shift(p). The archive's fields are the same thing told from the untouched side.
- channel 2: growth of the markers seen there [px of their radius], beyond what the shift stretches.
  Discs of a uSkin grow where they are pressed, though nothing there moves aside. It is a matter of
  whole markers and so kept coarse: fine growth could draw markers that are not there.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from learning.data.fields import sampled
from learning.data.procedural import untouched
from recorder.markers import HEIGHT, WIDTH, Lattice

CHANNELS = 3
"""Shift along columns, shift along rows, growth."""
SIDE = 64
"""Cells along either axis: 10 x 7.5 px each, the step of the archive's lattice."""
_GROWTH_CELLS = 4  # one value of growth is for so many cells along either axis: 40 x 30 px
_INVERSIONS = 12  # fixed-point steps; each shrinks the error by the largest slope of the field


def image_grid(height: int, width: int, device: torch.device) -> Tensor:
    """Return where the pixels of an image are, (1, height, width, 2) from -1 to 1 (column, row)."""
    column = (2 * torch.arange(width, device=device) + 1) / width - 1
    row = (2 * torch.arange(height, device=device) + 1) / height - 1
    across, down = torch.meshgrid(column, row, indexing="xy")
    return torch.stack([across, down], dim=-1).unsqueeze(0)


def render(distance: Tensor, deformation: Tensor) -> Tensor:
    """Return signed distances [px] of a reference that has been deformed, (n, 1, h, w).

    Outside of its image a reference is not known: a marker that its border cuts goes on there as
    far as it reaches into the image, and there is no other.

    Args:
        distance: Signed distance of references, (n, 1, h, w) or one for all (1, 1, h, w).
        deformation: (n, 3, any, any).
    """
    height, width = distance.shape[-2:]
    deformation = deformation.to(distance.dtype)
    fine: Tensor = functional.interpolate(
        deformation, size=(height, width), mode="bicubic", align_corners=False
    )
    shift = fine[:, :2] * _per_px(distance).view(1, 2, 1, 1)
    places = image_grid(height, width, distance.device) - shift.permute(0, 2, 3, 1)
    level: Tensor = functional.grid_sample(
        distance.expand(len(deformation), -1, -1, -1),
        places,
        mode="bilinear",
        padding_mode="border",
        align_corners=False,
    )
    beyond = torch.linalg.vector_norm((places.abs() - 1).clamp(min=0) / _per_px(distance), dim=-1)
    deformed: Tensor = level - beyond.unsqueeze(1) + fine[:, 2:]
    return deformed


def coverage(level: Tensor) -> Tensor:
    """Return an image in 0..1 of signed distances [px]: how much of a pixel a marker covers.

    The edge is taken to be straight over a pixel, whose size is that of the image given.
    """
    size = math.sqrt(HEIGHT * WIDTH / (level.shape[-2] * level.shape[-1]))
    covered: Tensor = (0.5 + level / size).clamp(0.0, 1.0)
    return covered


def coarse_growth(deformation: Tensor) -> Tensor:
    """Return a deformation (n, 3, h, w) whose growth is that of whole markers."""
    shift, growth = deformation[:, :2], deformation[:, 2:]
    coarse = functional.avg_pool2d(growth, _GROWTH_CELLS)
    spread: Tensor = functional.interpolate(
        coarse, size=growth.shape[-2:], mode="bilinear", align_corners=False
    )
    return torch.cat([shift, spread], dim=1)


def from_displacement(field: Tensor, lattice: Lattice, side: int = SIDE) -> Tensor:
    """Return shifts (n, 2, side, side) [px] of displacement fields, by fixed-point iteration.

    Args:
        field: Displacement (column, row) [px] at the lattice's points without NaN, (n, 2, h, w).
        lattice: Where they are.
        side: Cells along either axis.
    """
    columns, rows = untouched(side, field.device)[0]
    shift = torch.zeros(len(field), 2, side, side, device=field.device, dtype=field.dtype)
    for _ in range(_INVERSIONS):
        shift = sampled(field, columns - shift[:, 0], rows - shift[:, 1], lattice)
    return shift


def carried(deformation: Tensor, zoom: Tensor, placement: Tensor | None = None) -> Tensor:
    """Return what a deformation is in the image of another sensor, (n, 3, h, w), in its pixels.

    The middles of both images lie on each other, and millimetres stay what they are.

    Args:
        deformation: In the source's image (n, 3, h, w).
        zoom: Millimetres of a target's pixel over those of a source's, (n, 2) (column, row).
        placement: Change of where it is looked up, affine (n, 2, 3) from the target's image to the
            source's, both from -1 to 1; None: nothing is changed.
    """
    height, width = deformation.shape[-2:]
    grid = image_grid(height, width, deformation.device).expand(len(deformation), -1, -1, -1)
    places = grid * zoom.view(-1, 1, 1, 2)
    if placement is not None:
        # Written out: as a matrix product it would be rounded to bfloat16 under autocast.
        turned = (placement[:, None, None, :, :2] * places.unsqueeze(3)).sum(dim=-1)
        places = places + turned + placement[:, None, None, :, 2]
    looked_up: Tensor = functional.grid_sample(
        deformation, places, mode="bilinear", padding_mode="border", align_corners=False
    )
    scale = torch.cat([zoom, zoom.prod(dim=1, keepdim=True).sqrt()], dim=1)
    return looked_up / scale.view(-1, 3, 1, 1)


def _per_px(images: Tensor) -> Tensor:
    """Return how far a pixel of the 640 x 480 image is, of -1 to 1, (2,) (column, row)."""
    return images.new_tensor([2 / WIDTH, 2 / HEIGHT])
