"""Masks warped by displacement fields, many at once, on any device."""

from __future__ import annotations

import torch

from learning.data.fields import warp
from learning.translation.flow.edges import edge_level
from learning.translation.flow.fields import LATTICE

_TOGETHER = 64
"""Frames warped at once: 64 take some 0.5 GB."""


def warp_masks(reference: torch.Tensor, fields: torch.Tensor) -> torch.Tensor:
    """Return a reference as it is seen after displacements, bool (n, 480, 640).

    Args:
        reference: The untouched mask, bool (480, 640), anywhere.
        fields: Displacement on the lattice of archives (n, 57, 73, 2) [px], components column, row;
            where they are, it is warped.
    """
    level = torch.tensor(edge_level(reference.cpu().numpy()), device=fields.device)
    parts = []
    for field in fields.split(_TOGETHER):
        seen = warp(level[None, None], field.permute(0, 3, 1, 2), LATTICE)
        parts.append(seen[:, 0] > 0.5)
    return torch.cat(parts)
