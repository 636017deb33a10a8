"""How far two images show the same."""

from __future__ import annotations

from torch import Tensor


def soft_dice(images: Tensor, targets: Tensor) -> Tensor:
    """Return the soft Dice coefficient (n,) of images (n, 1, h, w) in 0..1; two empty ones: 1."""
    both = (images * targets).sum(dim=(1, 2, 3))
    each = (images.square() + targets.square()).sum(dim=(1, 2, 3))
    return (2 * both + 1) / (each + 1)
