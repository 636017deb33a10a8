"""The marker autoencoder: a convolutional encoder, a Gaussian latent, a decoder.

The direct translator encodes references with its encoder, and distances between sets of marker
images are computed from its pooled features. The paper uses the variational autoencoder of
SD-Turbo for this (the paper, Methods, "Marker encoder-decoder"); this one is small and trained from
scratch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

# Groups of a group normalisation; every width is a multiple of it.
GROUPS = 8


class ResidualBlock(nn.Module):
    """Residual block of two 3 x 3 convolutions; the shape is preserved."""

    def __init__(self, width: int) -> None:
        """Build a block of `width` channels."""
        super().__init__()
        self.norm_in = nn.GroupNorm(GROUPS, width)
        self.convolution_in = nn.Conv2d(width, width, 3, padding=1)
        self.norm_out = nn.GroupNorm(GROUPS, width)
        self.convolution_out = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, features: Tensor) -> Tensor:
        """Return features (n, c, h, w)."""
        inner: Tensor = self.convolution_in(functional.silu(self.norm_in(features)))
        inner = self.convolution_out(functional.silu(self.norm_out(inner)))
        return features + inner


class Encoder(nn.Module):
    """Encodes images into features at 1/2, 1/4 and 1/8 of their side."""

    def __init__(self, widths: Sequence[int], channels: int = 1) -> None:
        """Build it.

        Args:
            widths: Channels at the three scales.
            channels: Channels of an image.
        """
        super().__init__()
        self.widths = tuple(widths)
        self.halvings, self.blocks = nn.ModuleList(), nn.ModuleList()
        before, kernel = channels, 5
        for width in widths:
            self.halvings.append(nn.Conv2d(before, width, kernel, stride=2, padding=kernel // 2))
            self.blocks.append(ResidualBlock(width))
            before, kernel = width, 3

    def forward(self, images: Tensor) -> list[Tensor]:
        """Return features of images (n, channels, h, w) in 0..1, finest first."""
        scales, features = [], images
        for halving, block in zip(self.halvings, self.blocks, strict=True):
            features = block(halving(features))
            scales.append(features)
        return scales


class Decoder(nn.Module):
    """Decodes features at 1/8 of the side into logits of an image, with optional skip connections.

    Skip connections take features at 1/4 and 1/2, and an image at full size.
    """

    def __init__(self, widths: Sequence[int], *, skips: bool) -> None:
        """Build it.

        Args:
            widths: Channels at 1/2, 1/4 and 1/8.
            skips: True for skip connections.
        """
        super().__init__()
        fine, middle, coarse = widths
        last = max(GROUPS, fine // 2)
        self.block = ResidualBlock(coarse)
        self.joins, self.blocks = nn.ModuleList(), nn.ModuleList()
        for channels, width, skip in (
            (coarse, middle, middle),
            (middle, fine, fine),
            (fine, last, 1),
        ):
            self.joins.append(nn.Conv2d(channels + skip * skips, width, 3, padding=1))
            self.blocks.append(ResidualBlock(width))
        self.norm = nn.GroupNorm(GROUPS, last)
        self.logits = nn.Conv2d(last, 1, 3, padding=1)

    def forward(self, features: Tensor, skips: Sequence[Tensor] = ()) -> Tensor:
        """Return logits (n, 1, 8 h, 8 w).

        Args:
            features: Features at 1/8 (n, coarse, h, w).
            skips: Features at 1/4 and at 1/2, and an image; batch size n or 1.
        """
        features = self.block(features)
        for place, (join, block) in enumerate(zip(self.joins, self.blocks, strict=True)):
            features = functional.interpolate(features, scale_factor=2, mode="nearest")
            if skips:
                skip = skips[place].expand(len(features), -1, -1, -1)
                features = torch.cat([features, skip.to(features.dtype)], dim=1)
            features = block(join(features))
        logits: Tensor = self.logits(functional.silu(self.norm(features)))
        return logits


class Autoencoder(nn.Module):
    """Encodes marker images into a Gaussian latent at 1/8 of their side, and decodes it."""

    def __init__(self, widths: Sequence[int], latent: int) -> None:
        """Build it with untrained weights.

        Args:
            widths: Channels at 1/2, 1/4 and 1/8.
            latent: Channels of the latent.
        """
        super().__init__()
        self.encoder = Encoder(widths)
        self.to_latent = nn.Conv2d(widths[-1], 2 * latent, 1)
        self.from_latent = nn.Conv2d(latent, widths[-1], 3, padding=1)
        self.decoder = Decoder(widths, skips=False)

    def encode(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log variance (n, latent, h / 8, w / 8) of images (n, 1, h, w) in 0..1."""
        mean, log_variance = self.to_latent(self.encoder(images)[-1]).float().chunk(2, dim=1)
        return mean, log_variance.clamp(-30.0, 20.0)

    def forward(self, images: Tensor, noise: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return logits (n, 1, h, w), mean and log variance.

        Args:
            images: Images in 0..1 (n, 1, h, w).
            noise: Standard normal noise of the latent's shape; None: decode the mean, as the paper
                does for inference.
        """
        mean, log_variance = self.encode(images)
        latent = mean if noise is None else mean + noise * (0.5 * log_variance).exp()
        logits: Tensor = self.decoder(self.from_latent(latent))
        return logits, mean, log_variance

    def features(self, images: Tensor) -> Tensor:
        """Return pooled features (n, widths[-1]) of uint8 images (n, h, w)."""
        scaled = images.unsqueeze(1).to(self.to_latent.weight.dtype) / 255
        pooled: Tensor = self.encoder(scaled)[-1].mean(dim=(2, 3))
        return pooled


def divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return the KL divergence from a standard normal, summed per image and averaged."""
    terms = mean.square() + log_variance.exp() - 1 - log_variance
    return 0.5 * terms.sum(dim=(1, 2, 3)).mean()


# Images of training and their similarity.


def orient(images: list[Tensor], generator: np.random.Generator) -> list[Tensor]:
    """Return images mirrored and rotated by quarter turns at random, the same within a sample."""
    device, count = images[0].device, len(images[0])
    for dims in ((3,), (2,), None):
        chosen = torch.from_numpy(generator.random(count) < 0.5).to(device)[:, None, None, None]
        images = [
            torch.where(chosen, image.transpose(2, 3) if dims is None else image.flip(dims), image)
            for image in images
        ]
    return images


def soft_dice(images: Tensor, targets: Tensor) -> Tensor:
    """Return the soft Dice coefficient (n,) of images (n, 1, h, w) in 0..1; 1 if both are empty."""
    both = (images * targets).sum(dim=(1, 2, 3))
    each = (images.square() + targets.square()).sum(dim=(1, 2, 3))
    return (2 * both + 1) / (each + 1)
