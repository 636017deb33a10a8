"""A discriminator on CLIP features (vision-aided GAN, Kumari et al. 2022), and its augmentation.

Each of three frozen features of ViT-B/32 (after blocks 4 and 8, and the final projection) has a
small head; the paper uses it with the multilevel sigmoid loss.
"""

from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm

# Patch features are taken after these blocks of CLIP.
BLOCKS = (4, 8)
# Width of a head (vision-aided GAN).
HEAD_WIDTH = 256
# Label of true images: one-sided smooth labels, `multilevel_sigmoid_s`.
REAL = 0.8
# Mean colour of CLIP's training images in [0, 1].
PIXEL_MEAN = (0.48145466, 0.4578275, 0.40821073)
# Standard deviation of that colour.
PIXEL_DEVIATION = (0.26862954, 0.26130258, 0.27577711)
# Binomial filter before the heads halve the resolution (Zhang 2019).
BLUR = (1.0, 3.0, 3.0, 1.0)


class ClipFeatures(nn.Module):
    """CLIP's features of images in [-1, 1]: two rasters (n, width, h, w), a vector (n, width)."""

    def __init__(self, clip: Any) -> None:
        """Freeze a `CLIPVisionModelWithProjection`."""
        super().__init__()
        self.clip = clip.requires_grad_(False).eval()
        self.register_buffer("mean", torch.tensor(PIXEL_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer(
            "deviation", torch.tensor(PIXEL_DEVIATION).view(1, 3, 1, 1), persistent=False
        )

    def train(self, mode: bool = True) -> Self:
        """Stay in evaluation mode, as it is frozen."""
        return super().train(False)

    def forward(self, images: torch.Tensor) -> list[torch.Tensor]:
        """Return the features of images (n, 3, h, w) in [-1, 1]."""
        side = self.clip.config.image_size
        pixels = functional.interpolate(images * 0.5 + 0.5, size=(side, side), mode="area")
        pixels = (pixels - self.get_buffer("mean")) / self.get_buffer("deviation")
        outputs = self.clip(pixel_values=pixels, output_hidden_states=True)
        grid = side // self.clip.config.patch_size
        rasters = [
            outputs.hidden_states[block][:, 1:].transpose(1, 2).unflatten(2, (grid, grid)).float()
            for block in BLOCKS
        ]
        return [*rasters, outputs.image_embeds.float()]


class DiscriminatorHeads(nn.Module):
    """Heads on the features; the only trainable part of the discriminator."""

    def __init__(self, raster_width: int, vector_width: int, width: int = HEAD_WIDTH) -> None:
        """Build a head for each level; CLIP's blocks have 768 channels, its projection 512."""
        super().__init__()
        self.rasters = nn.ModuleList(
            nn.Sequential(
                spectral_norm(nn.Conv2d(raster_width, width, 3, padding=1)),
                nn.LeakyReLU(0.2),
                Blur(width),
                spectral_norm(nn.Conv2d(width, 1, 1, stride=2)),
            )
            for _ in BLOCKS
        )
        self.vector = nn.Sequential(
            spectral_norm(nn.Linear(vector_width, width)),
            nn.LeakyReLU(0.2),
            spectral_norm(nn.Linear(width, 1)),
        )

    def forward(self, features: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Return logits of every level: (n, 1, h, w) of the rasters, (n, 1) of the vector."""
        *rasters, vector = features
        logits = [head(raster) for head, raster in zip(self.rasters, rasters, strict=True)]
        return [*logits, self.vector(vector)]


class Blur(nn.Module):
    """A binomial filter on every channel that keeps the image size."""

    def __init__(self, channels: int) -> None:
        """Build the filter for `channels` channels."""
        super().__init__()
        line = torch.tensor(BLUR) / sum(BLUR)
        kernel = (line[:, None] * line).expand(channels, 1, -1, -1).clone()
        self.register_buffer("kernel", kernel, persistent=False)

    def forward(self, raster: torch.Tensor) -> torch.Tensor:
        """Return the blurred raster (n, channels, h, w), assuming zero beyond its border."""
        kernel: torch.Tensor = self.get_buffer("kernel").to(raster.dtype)
        return functional.conv2d(
            functional.pad(raster, (1, 2, 1, 2)), kernel, groups=raster.shape[1]
        )


def multilevel_sigmoid(logits: Sequence[torch.Tensor], *, real: bool) -> torch.Tensor:
    """Return the loss of logits against `REAL` or 0, over levels, mean of positions and images."""
    total = torch.zeros((), device=logits[0].device)
    for level in logits:
        wanted = torch.full_like(level, REAL if real else 0.0, dtype=torch.float32)
        total = total + functional.binary_cross_entropy_with_logits(level.float(), wanted)
    return total


# Augmentation of true and translated images before the discriminator.
#
# Differentiable augmentation (Zhao et al. 2020) with its own ranges, as the vision-aided
# discriminator uses it: colour, translation, cutout. Pixels shifted in or cut out become 0.

# Largest shift, as a fraction of the side.
TRANSLATION = 1 / 8
# Side of the square that is cut out, as a fraction of the image's.
CUTOUT = 1 / 2


def augment(images: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return images (n, channels, h, w), each augmented independently at random."""
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
    rows, columns = _pixel_indices(images)
    for axis, positions in ((2, rows), (3, columns)):
        side = images.shape[axis]
        most = int(side * TRANSLATION + 0.5)
        shift = _integers(-most, most + 1, images, generator)
        origins = positions - shift
        inside = (origins >= 0) & (origins < side)
        index = origins.clamp(0, side - 1).expand_as(images)
        images = images.gather(axis, index) * inside
    return images


def _cut(images: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    outside = torch.zeros((), dtype=torch.bool, device=images.device)
    for axis, positions in zip((2, 3), _pixel_indices(images), strict=True):
        side = images.shape[axis]
        size = int(side * CUTOUT + 0.5)
        first = _integers(0, side + 1 - size % 2, images, generator) - size // 2
        outside = outside | (positions < first) | (positions >= first + size)
    return images * outside


def _pixel_indices(images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return row indices (1, 1, h, 1) and column indices (1, 1, 1, w)."""
    height, width = images.shape[2:]
    rows = torch.arange(height, device=images.device).view(1, 1, -1, 1)
    return rows, torch.arange(width, device=images.device).view(1, 1, 1, -1)


def _integers(
    low: int, high: int, images: torch.Tensor, generator: torch.Generator
) -> torch.Tensor:
    shape = (len(images), 1, 1, 1)
    return torch.randint(low, high, shape, generator=generator, device=images.device)
