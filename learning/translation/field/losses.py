"""Losses and scores that compare a deformed reference with the frame the sensor showed."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from learning.errors import LearningError
from learning.translation.field.network import coverage

# Width of the logistic that is as steep at an edge as a pixel of 256 x 256, 2.2 px wide.
_RAMP_PX = 0.55
# Logits grow logarithmically beyond this, so that distant errors count but do not dominate.
_CERTAIN = 8.0


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights of the parts of the loss."""

    cross_entropy: float = 1.0
    """Cross-entropy of pixels on logits of signed distances: has a gradient at any distance."""
    dice: float = 1.0
    """One minus the soft Dice of the images."""
    truth: float = 0.05
    """Mean error [px] of shift, and of growth from 0, if the archive has displacement fields."""
    rough: float = 0.02
    """Mean square of second differences of the shift [px^2]: no data between the markers."""
    growth: float = 0.01
    """Mean magnitude of growth [px]: a shift is preferred where it explains the frame."""
    unknown: float = 0.02
    """Mean change [px] by the map between two random patterns on the same gel and camera."""

    def __post_init__(self) -> None:
        """Reject invalid weights.

        Raises:
            LearningError: A weight is negative, or no weight refers to the image.
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
        images: Frames of the sensor, in 0..1 (n, 1, h, w).
        weights: Weights of the parts.
    """
    logits = _CERTAIN * torch.asinh(level / (_RAMP_PX * _CERTAIN))
    entropy = functional.binary_cross_entropy_with_logits(logits, images)
    return weights.cross_entropy * entropy + weights.dice * (1 - soft_dice(level, images).mean())


def regularity_loss(deformation: Tensor, weights: LossWeights) -> Tensor:
    """Return the regularisation loss of a deformation (n, 3, h, w): roughness and growth."""
    shift, growth = deformation[:, :2], deformation[:, 2:]
    bent = shift.diff(n=2, dim=2).square().mean() + shift.diff(n=2, dim=3).square().mean()
    return weights.rough * bent + weights.growth * growth.abs().mean()


def truth_error(deformation: Tensor, shift: Tensor) -> Tensor:
    """Return the mean distance (n,) [px] from the true deformation, growth as a third direction.

    A known field is the complete deformation: the true growth is 0.

    Args:
        deformation: (n, 3, h, w).
        shift: True shift (n, 2, h, w); NaN where it is unknown and not counted.
    """
    grown = deformation[:, 2:]
    return shift_error(deformation, shift, grown.square().sum(dim=1))


def shift_error(deformation: Tensor, shift: Tensor, more: Tensor | float = 0.0) -> Tensor:
    """Return the mean distance (n,) [px] between a deformation's shift and the true one.

    Args:
        deformation: (n, 3, h, w).
        shift: True shift (n, 2, h, w); NaN where it is unknown and not counted.
        more: Square of other errors to add (n, h, w) [px^2].
    """
    known = shift.isfinite().all(dim=1)
    apart = (deformation[:, :2] - shift.nan_to_num()).square().sum(dim=1) + more
    # The gradient of the root is infinite at zero.
    distance = (apart + 1e-6).sqrt() * known
    return distance.sum(dim=(1, 2)) / known.sum(dim=(1, 2)).clamp(min=1)


def soft_dice(level: Tensor, images: Tensor) -> Tensor:
    """Return the soft Dice coefficient (n,) of deformed references; 1 if both images are empty."""
    drawn = torch.sigmoid(level / _RAMP_PX)
    both = (drawn * images).sum(dim=(1, 2, 3))
    each = drawn.square().sum(dim=(1, 2, 3)) + images.square().sum(dim=(1, 2, 3))
    return (2 * both + 1) / (each + 1)


def dice(level: Tensor, images: Tensor) -> Tensor:
    """Return the Dice coefficient (n,) of thresholded images; 1 if both are empty.

    Args:
        level: Signed distance of the predicted frames (n, 1, h, w) [px].
        images: True frames, in 0..1 (n, 1, h, w).
    """
    made, due = coverage(level) > 0.5, images > 0.5
    both = (made & due).sum(dim=(1, 2, 3))
    each = made.sum(dim=(1, 2, 3)) + due.sum(dim=(1, 2, 3))
    return torch.where(
        each > 0, 2 * both / each.clamp(min=1), torch.ones_like(both, dtype=torch.float32)
    )
