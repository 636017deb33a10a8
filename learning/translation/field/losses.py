"""How well a deformed reference agrees with what the sensor really showed."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from learning.errors import LearningError
from learning.translation.field.network import coverage

_RAMP_PX = 0.55  # a pixel of 256 x 256 is 2.2 px wide: the logistic that is as steep at the edge
_CERTAIN = 8.0  # logits grow by their logarithm beyond: what was missed far away counts, not all


@dataclass(frozen=True, slots=True)
class LossWeights:
    """How much each part counts."""

    cross_entropy: float = 1.0
    """Of pixels, with the logits of signed distances: it pulls however far a marker is off."""
    dice: float = 1.0
    """One less the soft Dice of the images."""
    truth: float = 0.05
    """Mean error [px] of shift and growth where the archive keeps displacement: nothing grows."""
    rough: float = 0.02
    """Mean square of second differences of the shift [px^2]: markers say nothing between them."""
    growth: float = 0.01
    """Mean magnitude of growth [px]: what a shift can explain is a shift."""
    unknown: float = 0.02
    """Mean error [px] of the map between two random patterns: one gel, one camera."""

    def __post_init__(self) -> None:
        """Refuse what would be learned away from.

        Raises:
            LearningError: A negative weight, or none that looks at the image.
        """
        for name in ("cross_entropy", "dice", "truth", "rough", "growth", "unknown"):
            if getattr(self, name) < 0:
                raise LearningError(f"{name}: found {getattr(self, name)}; allowed: 0 or more")
        if not self.cross_entropy and not self.dice:
            raise LearningError("cross_entropy, dice: found 0 and 0; allowed: one of them above 0")


def image_loss(level: Tensor, images: Tensor, weights: LossWeights) -> Tensor:
    """Return the loss of deformed references.

    Args:
        level: Their signed distance (n, 1, h, w) [px].
        images: What the sensor showed, in 0..1 (n, 1, h, w).
        weights: Of the parts.
    """
    logits = _CERTAIN * torch.asinh(level / (_RAMP_PX * _CERTAIN))
    entropy = functional.binary_cross_entropy_with_logits(logits, images)
    return weights.cross_entropy * entropy + weights.dice * (1 - soft_dice(level, images).mean())


def regularity_loss(deformation: Tensor, weights: LossWeights) -> Tensor:
    """Return what a deformation (n, 3, h, w) costs by itself."""
    shift, growth = deformation[:, :2], deformation[:, 2:]
    bent = shift.diff(n=2, dim=2).square().mean() + shift.diff(n=2, dim=3).square().mean()
    return weights.rough * bent + weights.growth * growth.abs().mean()


def truth_error(deformation: Tensor, shift: Tensor) -> Tensor:
    """Return the mean distance (n,) [px] from the true deformation, growth as a third direction.

    Where a field is kept it says all: markers do not grow beside it.

    Args:
        deformation: (n, 3, h, w).
        shift: The true one (n, 2, h, w); NaN where it is not known, and nothing counts there.
    """
    grown = deformation[:, 2:]
    return shift_error(deformation, shift, grown.square().sum(dim=1))


def shift_error(deformation: Tensor, shift: Tensor, more: Tensor | float = 0.0) -> Tensor:
    """Return the mean distance (n,) [px] between a deformation's shift and the true one.

    Args:
        deformation: (n, 3, h, w).
        shift: (n, 2, h, w); NaN where it is not known, and nothing counts there.
        more: Square of what else is wrong (n, h, w) [px^2].
    """
    known = shift.isfinite().all(dim=1)
    apart = (deformation[:, :2] - shift.nan_to_num()).square().sum(dim=1) + more
    # A root has no slope at zero.
    distance = (apart + 1e-6).sqrt() * known
    return distance.sum(dim=(1, 2)) / known.sum(dim=(1, 2)).clamp(min=1)


def soft_dice(level: Tensor, images: Tensor) -> Tensor:
    """Return the soft Dice coefficient (n,) of deformed references; of two empty images 1."""
    drawn = torch.sigmoid(level / _RAMP_PX)
    both = (drawn * images).sum(dim=(1, 2, 3))
    each = drawn.square().sum(dim=(1, 2, 3)) + images.square().sum(dim=(1, 2, 3))
    return (2 * both + 1) / (each + 1)


def dice(level: Tensor, images: Tensor) -> Tensor:
    """Return the Dice coefficient (n,) of thresholded images; of two empty ones 1.

    Args:
        level: Signed distance of what was made (n, 1, h, w) [px].
        images: What there should be, in 0..1 (n, 1, h, w).
    """
    made, due = coverage(level) > 0.5, images > 0.5
    both = (made & due).sum(dim=(1, 2, 3))
    each = made.sum(dim=(1, 2, 3)) + due.sum(dim=(1, 2, 3))
    return torch.where(
        each > 0, 2 * both / each.clamp(min=1), torch.ones_like(both, dtype=torch.float32)
    )
