"""What is done alike to true and translated images before they are judged.

Differentiable augmentation (Zhao et al. 2020) with its own ranges, as the vision-aided
discriminator uses it: colour, translation, cutout. What leaves the image or is cut out becomes 0.
"""

from __future__ import annotations

import torch

TRANSLATION = 1 / 8
"""Largest shift, as a part of the side."""
CUTOUT = 1 / 2
"""Side of the square that is cut out, as a part of the image's."""


def augment(images: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return images (n, channels, h, w) changed at random, every image by itself."""
    return _cut(_shift(_colour(images, generator), generator), generator)


def _colour(images: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Change brightness by +-0.5, saturation by 0 to 2 and contrast by 0.5 to 1.5 times."""
    brightness, saturation, contrast = torch.rand(
        (3, len(images), 1, 1, 1), generator=generator, device=images.device
    )
    images = images + (brightness - 0.5)
    grey = images.mean(dim=1, keepdim=True)
    images = (images - grey) * (2 * saturation) + grey
    mean = images.mean(dim=(1, 2, 3), keepdim=True)
    changed: torch.Tensor = (images - mean) * (contrast + 0.5) + mean
    return changed


def _shift(images: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    rows, columns = _places(images)
    for axis, places in ((2, rows), (3, columns)):
        side = images.shape[axis]
        most = int(side * TRANSLATION + 0.5)
        shift = _integers(-most, most + 1, images, generator)
        taken = places - shift
        inside = (taken >= 0) & (taken < side)
        index = taken.clamp(0, side - 1).expand_as(images)
        images = images.gather(axis, index) * inside
    return images


def _cut(images: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    kept = torch.zeros((), dtype=torch.bool, device=images.device)
    for axis, places in zip((2, 3), _places(images), strict=True):
        side = images.shape[axis]
        size = int(side * CUTOUT + 0.5)
        first = _integers(0, side + 1 - size % 2, images, generator) - size // 2
        kept = kept | (places < first) | (places >= first + size)
    return images * kept


def _places(images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return numbers of rows (1, 1, h, 1) and of columns (1, 1, 1, w)."""
    height, width = images.shape[2:]
    rows = torch.arange(height, device=images.device).view(1, 1, -1, 1)
    return rows, torch.arange(width, device=images.device).view(1, 1, 1, -1)


def _integers(
    low: int, high: int, images: torch.Tensor, generator: torch.Generator
) -> torch.Tensor:
    shape = (len(images), 1, 1, 1)
    return torch.randint(low, high, shape, generator=generator, device=images.device)
