"""LPIPS: how different two images look to VGG16 (Zhang et al. 2018, version 0.1).

The trunk has torchvision's names of parameters (`features.0.weight`, ...), so that its file loads
as it is; the linear heads are those of the lpips package.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

WIDTHS = (64, 128, 256, 512, 512)
"""Channels of VGG16's five stages."""
LAYERS = (2, 2, 3, 3, 3)
"""Convolutions of each stage; features are taken behind the last one's ReLU."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""ImageNet's mean and deviation for images in [-1, 1] (lpips' scaling layer)."""
LEAST_SQUARE = 1e-10
"""Added under the root, which has no slope where all features are zero."""


class PerceptualDistance(nn.Module):
    """LPIPS of images in [-1, 1], (n,): 0 of equal ones. Frozen."""

    def __init__(self, widths: Sequence[int] = WIDTHS) -> None:
        """Make trunk and heads with random weights.

        Args:
            widths: Channels of the five stages.
        """
        super().__init__()
        layers: list[nn.Module] = []
        self.taps: list[int] = []
        before = 3
        for stage, (width, count) in enumerate(zip(widths, LAYERS, strict=True)):
            if stage:
                layers.append(nn.MaxPool2d(2))
            for _ in range(count):
                layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()]
                before = width
            self.taps.append(len(layers) - 1)
        self.features = nn.Sequential(*layers)
        self.heads = nn.ParameterList(
            nn.Parameter(torch.rand(1, width, 1, 1) / width) for width in widths
        )
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1), persistent=False)
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> PerceptualDistance:
        """Stay in evaluation: it is frozen."""
        return super().train(False)

    def forward(self, images: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """Return the distance of images (n, 3, h, w) to others of that shape, (n,)."""
        pairs = zip(self._stages(images), self._stages(others), self.heads, strict=True)
        distance = torch.zeros(len(images), device=images.device)
        for one, other, head in pairs:
            apart = (_unit(one) - _unit(other)) ** 2
            distance = distance + (apart * head).sum(dim=1).mean(dim=(1, 2))
        return distance

    def _stages(self, images: torch.Tensor) -> list[torch.Tensor]:
        seen = (images - self.get_buffer("shift")) / self.get_buffer("scale")
        found = []
        for place, layer in enumerate(self.features):
            seen = layer(seen)
            if place in self.taps:
                found.append(seen.float())
        return found


def _unit(features: torch.Tensor) -> torch.Tensor:
    square = (features**2).sum(dim=1, keepdim=True)
    return features / (square + LEAST_SQUARE).sqrt()
