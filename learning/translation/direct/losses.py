"""Reconstruction losses for training the direct network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from learning.translation.direct.autoencoder import Encoder, soft_dice


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights of the losses; a loss with weight 0 is not computed."""

    cross_entropy: float = 1.0
    """Cross-entropy of pixels."""
    dice: float = 1.0
    """1 - soft Dice of an image."""
    perceptual: float = 0.1
    """Mean absolute difference of features of the frozen reference encoder, at its three scales."""
    adversarial: float = 0.0
    """Loss of a discriminator; helps if the source does not determine the target (few taxels)."""


def perceptual(encoder: Encoder, images: Tensor, targets: Tensor) -> Tensor:
    """Return the mean absolute difference of an encoder's features, averaged over its scales."""
    with torch.no_grad():
        wanted: Sequence[Tensor] = encoder(targets)
    found = encoder(images)
    gaps = [
        functional.l1_loss(one.float(), other.float())
        for one, other in zip(found, wanted, strict=True)
    ]
    return torch.stack(gaps).mean()


def reconstruction(
    logits: Tensor, targets: Tensor, encoder: Encoder, weights: LossWeights
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the weighted reconstruction loss, and its parts for the log.

    Args:
        logits: Logits of the translated images (n, 1, h, w).
        targets: Anti-aliased images in 0..1 (n, 1, h, w).
        encoder: The frozen reference encoder.
        weights: Weights of the parts.
    """
    logits = logits.float()
    images = logits.sigmoid()
    parts: dict[str, Tensor] = {}
    if weights.cross_entropy:
        parts["cross_entropy"] = functional.binary_cross_entropy_with_logits(logits, targets)
    if weights.dice:
        parts["dice"] = 1 - soft_dice(images, targets).mean()
    if weights.perceptual:
        parts["perceptual"] = perceptual(encoder, images, targets)
    total = torch.zeros((), device=logits.device)
    for name, value in parts.items():
        total = total + getattr(weights, name) * value
    parts["l2"] = functional.mse_loss(images.detach(), targets)
    return total, parts
