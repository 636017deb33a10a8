"""A discriminator that sees through CLIP's eyes (vision-aided GAN, Kumari et al. 2022).

Frozen features of ViT-B/32 after blocks 4 and 8 and its final projection are judged by a small head
each; the paper uses it with the multilevel sigmoid loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm

BLOCKS = (4, 8)
"""After these of CLIP's blocks the patches' features are taken."""
HEAD_WIDTH = 256
"""Width of a head (vision-aided GAN)."""
REAL = 0.8
"""What true images should be judged as: one-sided smooth labels, `multilevel_sigmoid_s`."""
PIXEL_MEAN = (0.48145466, 0.4578275, 0.40821073)
"""Mean colour of the images CLIP was trained on, of [0, 1]."""
PIXEL_DEVIATION = (0.26862954, 0.26130258, 0.27577711)
"""Its standard deviation."""
BLUR = (1.0, 3.0, 3.0, 1.0)
"""Binomial filter before the heads halve their raster (Zhang 2019)."""


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

    def train(self, mode: bool = True) -> ClipFeatures:
        """Stay in evaluation: it is frozen."""
        return super().train(False)

    def forward(self, images: torch.Tensor) -> list[torch.Tensor]:
        """Return the features of images (n, 3, h, w) in [-1, 1]."""
        side = self.clip.config.image_size
        seen = functional.interpolate(images * 0.5 + 0.5, size=(side, side), mode="area")
        seen = (seen - self.get_buffer("mean")) / self.get_buffer("deviation")
        found = self.clip(pixel_values=seen, output_hidden_states=True)
        grid = side // self.clip.config.patch_size
        rasters = [
            found.hidden_states[block][:, 1:].transpose(1, 2).unflatten(2, (grid, grid)).float()
            for block in BLOCKS
        ]
        return [*rasters, found.image_embeds.float()]


class DiscriminatorHeads(nn.Module):
    """What judges the features; the only part of the discriminator that learns."""

    def __init__(self, raster_width: int, vector_width: int, width: int = HEAD_WIDTH) -> None:
        """Make a head for each level.

        Args:
            raster_width: Channels of CLIP's blocks (768).
            vector_width: Width of its projection (512).
            width: Of the heads.
        """
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
        judged = [head(raster) for head, raster in zip(self.rasters, rasters, strict=True)]
        return [*judged, self.vector(vector)]


class Blur(nn.Module):
    """A binomial filter over every channel, of the same size out as in."""

    def __init__(self, channels: int) -> None:
        """Make the filter for so many channels."""
        super().__init__()
        line = torch.tensor(BLUR) / sum(BLUR)
        kernel = (line[:, None] * line).expand(channels, 1, -1, -1).clone()
        self.register_buffer("kernel", kernel, persistent=False)

    def forward(self, raster: torch.Tensor) -> torch.Tensor:
        """Return the raster (n, channels, h, w) blurred, zero beyond its border."""
        kernel: torch.Tensor = self.get_buffer("kernel").to(raster.dtype)
        return functional.conv2d(
            functional.pad(raster, (1, 2, 1, 2)), kernel, groups=raster.shape[1]
        )


def multilevel_sigmoid(logits: Sequence[torch.Tensor], *, real: bool) -> torch.Tensor:
    """Return the loss of logits, summed over levels, averaged over places and images.

    Args:
        logits: Of every level, of any shape.
        real: Whether they should say `REAL` (true images, or the generator's aim), or 0.
    """
    total = torch.zeros((), device=logits[0].device)
    for level in logits:
        wanted = torch.full_like(level, REAL if real else 0.0, dtype=torch.float32)
        total = total + functional.binary_cross_entropy_with_logits(level.float(), wanted)
    return total
