"""The marker autoencoder: a convolutional encoder, a Gaussian latent, a decoder.

The direct translator encodes references with its encoder, and distances between sets of marker
images are computed from its pooled features. The paper uses the variational autoencoder of
SD-Turbo for this (the paper, Methods, "Marker encoder-decoder"); this one is small and trained from
scratch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from learning.data.images import SIDE
from learning.data.presses import read_frames
from learning.data.splits import Role, Split
from learning.data.synthetic import before, random_fields, sample_patterns
from learning.errors import LearningError
from learning.training.checkpoint import read_model_folder
from learning.training.optim import Constant, Cosine, Schedule
from learning.training.run import LaunchSettings, generator
from recorder import MarkerArchive

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


# Training images of an autoencoder: frames of archives, random patterns, and mirrored or turned
# images.


def read_images(
    archives: Sequence[tuple[MarkerArchive, Split]],
    role: Role,
    *,
    most: int,
    seed: int,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Tensor:
    """Return frames (n, 256, 256) uint8 of a role from all sensors that no split holds out.

    Args:
        archives: Archives with their splits.
        role: Role of the locations to read.
        most: Largest number of frames, chosen at random.
        seed: Seed of the choice.
        device: Device for the images.
        progress: Called with the number of images read and the total.

    Raises:
        LearningError: A split belongs to another archive.
        SessionError: An archive is unfinished or damaged.
    """
    sensors, rows = [], []
    for archive, split in archives:
        split.check(archive)
        for name in split.trained_sensors(archive):
            sensors.append(archive[name])
            rows.append(split.rows(archive[name].table, role))
    counts = [len(each) for each in rows]
    chosen = np.sort(generator(seed, "images", role).permutation(sum(counts))[:most])
    device = torch.device(device)
    images = torch.empty(len(chosen), SIDE, SIDE, dtype=torch.uint8, device=device)
    done = begin = 0
    for sensor, mine in zip(sensors, rows, strict=True):
        taken = mine[chosen[(chosen >= begin) & (chosen < begin + len(mine))] - begin]
        begin += len(mine)
        end = done + len(taken)
        images[done:end] = read_frames(sensor, taken, device)
        progress(end, len(chosen))
        done = end
    return images


def deformed_patterns(
    count: int, chance: np.random.Generator, device: torch.device, side: int = SIDE
) -> Tensor:
    """Return random patterns under made-up deformations (count, 1, side, side) in 0..1."""
    patterns = sample_patterns(count, chance, device)
    return patterns.draw(before(random_fields(count, chance, device), None, side))


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


def scaled(images: Tensor) -> Tensor:
    """Return uint8 images (n, h, w) as float32 in 0..1 (n, 1, h, w)."""
    return images.unsqueeze(1).float() / 255


# Similarity of two images.


def soft_dice(images: Tensor, targets: Tensor) -> Tensor:
    """Return the soft Dice coefficient (n,) of images (n, 1, h, w) in 0..1; 1 if both are empty."""
    both = (images * targets).sum(dim=(1, 2, 3))
    each = (images.square() + targets.square()).sum(dim=(1, 2, 3))
    return (2 * both + 1) / (each + 1)


# Settings of an autoencoder and its training; presets are in `presets/`.

# YAML files, one per preset.
PRESETS = Path(__file__).parent / "presets" / "autoencoder"


@dataclass(frozen=True, slots=True)
class AutoencoderSettings:
    """Settings of a training, apart from its data."""

    description: str
    """Purpose of the preset."""
    widths: tuple[int, int, int] = (48, 96, 256)
    """Channels at 1/2, 1/4 and 1/8 of the side; the last is the number of pooled features."""
    latent: int = 8
    """Channels of the latent."""
    absolute: float = 1.0
    """Weight of the mean absolute error (the paper, Methods)."""
    squared: float = 1.0
    """Weight of the mean squared error (the paper, Methods)."""
    divergence: float = 1e-6
    """Weight of the divergence from a standard normal, summed over an image (the paper)."""
    procedural: float = 0.5
    """Share of random patterns under made-up deformations; 1 without an archive."""
    orientation: bool = True
    """Mirror images and rotate them by quarter turns."""
    most_images: int = 100_000
    """Largest number of archive images in memory, chosen at random (64 KiB each)."""
    steps: int = 20_000
    """Number of optimiser steps."""
    batch: int = 64
    """Batch size over all devices."""
    learning_rate: float = 3e-4
    """Peak rate of AdamW, reached after `warm_up` steps."""
    warm_up: int = 500
    """Number of steps over which the learning rate rises."""
    fall: Literal["cosine", "no"] = "cosine"
    """Decay of the learning rate to 0 at the last step."""
    weight_decay: float = 1e-2
    """Weight decay of AdamW."""
    clip: float = 1.0
    """Gradient norm above which gradients are clipped."""
    average: float = 0.999
    """Decay of the running average of weights per step; the average is the model."""
    seed: int = 0
    """Seed of everything random."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices and precision."""
    validate_every: int = 500
    """Number of steps between validations."""
    validation_images: int = 512
    """Largest number of images in a validation."""
    save_every: int = 1000
    """Number of steps between checkpoints."""

    def __post_init__(self) -> None:
        for name in ("latent", "steps", "batch", "validate_every", "save_every", "most_images"):
            if getattr(self, name) < 1:
                raise LearningError(f"{name}: found {getattr(self, name)}; allowed: 1 or more")
        if any(width < 8 or width % 8 for width in self.widths):
            raise LearningError(f"widths: found {self.widths}; allowed: multiples of 8")
        if not 0 <= self.procedural <= 1:
            raise LearningError(f"procedural: found {self.procedural}; allowed: 0 to 1")

    @property
    def schedule(self) -> Schedule:
        """Learning rate by step.

        Raises:
            LearningError: Warm-up takes all steps, or the rate is invalid.
        """
        if self.fall == "no":
            return Constant(self.learning_rate, self.warm_up)
        return Cosine(self.learning_rate, self.steps, self.warm_up)


# Load a trained autoencoder from its folder.

# Kind of model in its folder.
KIND = "autoencoder"


def load_autoencoder(folder: Path, device: torch.device | str = "cpu") -> Autoencoder:
    """Return the autoencoder in a folder, in evaluation mode.

    Args:
        folder: A finished run of `train-autoencoder`, or one of its checkpoints.
        device: Device to compute on.

    Raises:
        LearningError: The folder does not exist, its model is of another kind, or its weights do
            not fit.
    """
    found = read_model_folder(folder, KIND)
    settings = found.settings(AutoencoderSettings)
    network = Autoencoder(settings.widths, settings.latent)
    found.load(network)
    return network.to(device).eval()
