"""A discriminator on CLIP features (vision-aided GAN, Kumari et al. 2022), and the losses.

Each of three frozen features of ViT-B/32 (after blocks 4 and 8, and the final projection) has a
small head; the paper uses it with the multilevel sigmoid loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm

from learning.translation.diffusion.data import augment
from learning.translation.diffusion.network import MarkerToMarker
from learning.translation.diffusion.settings import LossWeights
from learning.translation.diffusion.weights import PerceptualDistance

if TYPE_CHECKING:
    from accelerate import Accelerator


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

    def train(self, mode: bool = True) -> ClipFeatures:
        """Stay in evaluation mode, as it is frozen."""
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
    """Heads on the features; the only trainable part of the discriminator."""

    def __init__(self, raster_width: int, vector_width: int, width: int = HEAD_WIDTH) -> None:
        """Build a head for each level.

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
    """Return the loss of logits, summed over levels and averaged over positions and images.

    Args:
        logits: Logits of every level, of any shape.
        real: True if the label is `REAL` (true images, or the generator's aim), False if it is 0.
    """
    total = torch.zeros((), device=logits[0].device)
    for level in logits:
        wanted = torch.full_like(level, REAL if real else 0.0, dtype=torch.float32)
        total = total + functional.binary_cross_entropy_with_logits(level.float(), wanted)
    return total


# One step of generator and discriminator, in two variants.
#
# `merged` evaluates the generator once: reconstruction and adversary share a backward pass and an
# optimiser step. `two_pass` follows the authors' code: a pass and a step for reconstruction,
# another for the adversary, and two steps of the discriminator.


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Inputs and true outputs of the generator."""

    source: torch.Tensor
    """Source images (n, 1, h, w) in [0, 1]."""
    target: torch.Tensor
    """Target images, likewise."""
    target_reference: torch.Tensor
    """Latents of the untouched target."""
    source_reference: torch.Tensor | None
    """Latents of the untouched source, if they are an input."""
    noise: torch.Tensor | None
    """Standard normal noise of a latent's shape; None: use the posterior's mean."""
    generator: torch.Generator
    """Random generator of augmentation."""


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """A trainable network with its optimiser."""

    network: nn.Module
    """The network, wrapped for distributed training on several devices."""
    optimiser: torch.optim.Optimizer
    """Optimiser of its trainable parameters."""
    clip_norm: float
    """Gradient norm above which gradients are clipped; 0: no clipping."""


@dataclass(frozen=True, slots=True, eq=False)
class Judges:
    """Losses and networks that evaluate the generator's images."""

    losses: LossWeights
    """Weights of the losses."""
    perceptual: PerceptualDistance | None
    """LPIPS; None if its weight is 0."""
    features: ClipFeatures | None
    """CLIP's features; None if the adversary's weight is 0."""
    heads: Side | None
    """Heads of the discriminator; None likewise."""


def merged(
    batches: Sequence[Batch], generator: Side, judges: Judges, runs_on: Accelerator
) -> dict[str, torch.Tensor]:
    """Train one step on its batches; return the mean of each unweighted loss."""
    share = 1 / len(batches)
    reported: list[dict[str, torch.Tensor]] = []
    shown = []
    for number, batch in enumerate(batches):
        with _synchronised(generator.network, number == len(batches) - 1, runs_on):
            made = _translate(generator.network, batch)
            parts = _reconstruction(made, batch, generator, judges, runs_on)
            if judges.heads is not None:
                parts["adversarial"] = _fooling(made, batch, judges, runs_on)
            runs_on.backward(_weighted(parts, judges.losses) * share)
        reported.append({name: part.detach() for name, part in parts.items()})
        shown.append(made.detach())
    _advance(generator, runs_on)
    if judges.heads is not None and judges.features is not None:
        for number, (batch, made) in enumerate(zip(batches, shown, strict=True)):
            # One pass for both, since every pass updates the spectral norms.
            both = torch.cat((_native(batch, generator, runs_on), made))
            with _synchronised(judges.heads.network, number == len(batches) - 1, runs_on):
                logits = judges.heads.network(_seen(both, batch, judges.features))
                true, fake = zip(*(level.chunk(2) for level in logits), strict=True)
                loss = multilevel_sigmoid(true, real=True) + multilevel_sigmoid(fake, real=False)
                runs_on.backward(loss * judges.losses.adversarial * share)
            reported[number]["discriminator"] = loss.detach()
        _advance(judges.heads, runs_on)
    return {name: torch.stack([each[name] for each in reported]).mean() for name in reported[0]}


def two_pass(
    batch: Batch, generator: Side, judges: Judges, runs_on: Accelerator
) -> dict[str, torch.Tensor]:
    """Train one step on one batch as the authors' code does; return the unweighted losses."""
    parts = _reconstruction(_translate(generator.network, batch), batch, generator, judges, runs_on)
    runs_on.backward(_weighted(parts, judges.losses))
    _advance(generator, runs_on)
    if judges.heads is None or judges.features is None:
        return {name: part.detach() for name, part in parts.items()}
    made = _translate(generator.network, batch)
    parts["adversarial"] = _fooling(made, batch, judges, runs_on)
    runs_on.backward(parts["adversarial"] * judges.losses.adversarial)
    _advance(generator, runs_on)
    judged = []
    for shown, real in ((_native(batch, generator, runs_on), True), (made.detach(), False)):
        loss = multilevel_sigmoid(
            judges.heads.network(_seen(shown, batch, judges.features)), real=real
        )
        runs_on.backward(loss * judges.losses.adversarial)
        _advance(judges.heads, runs_on)
        judged.append(loss)
    parts["discriminator"] = judged[0] + judged[1]
    return {name: part.detach() for name, part in parts.items()}


def _translate(network: nn.Module, batch: Batch) -> torch.Tensor:
    made: torch.Tensor = network(
        batch.source, batch.target_reference, batch.source_reference, batch.noise
    )
    return made


def _native(batch: Batch, generator: Side, runs_on: Accelerator) -> torch.Tensor:
    network: MarkerToMarker = runs_on.unwrap_model(generator.network)
    return network.native(batch.target)


def _reconstruction(
    made: torch.Tensor, batch: Batch, generator: Side, judges: Judges, runs_on: Accelerator
) -> dict[str, torch.Tensor]:
    true = _native(batch, generator, runs_on)
    parts = {"square": functional.mse_loss(made, true)}
    if judges.perceptual is not None:
        parts["perceptual"] = judges.perceptual(made, true).mean()
    return parts


def _fooling(
    made: torch.Tensor, batch: Batch, judges: Judges, runs_on: Accelerator
) -> torch.Tensor:
    """Return the generator's adversarial loss, with frozen heads."""
    if judges.heads is None or judges.features is None:
        return made.new_zeros(())
    # Unwrapped, so that the generator's backward pass does not synchronise the heads.
    heads = runs_on.unwrap_model(judges.heads.network).requires_grad_(False)
    try:
        seen = judges.features(augment(made, batch.generator))
        return multilevel_sigmoid(heads(seen), real=True)
    finally:
        heads.requires_grad_(True)


def _seen(shown: torch.Tensor, batch: Batch, features: ClipFeatures) -> list[torch.Tensor]:
    with torch.no_grad():
        found: list[torch.Tensor] = features(augment(shown, batch.generator))
    return found


def _weighted(parts: dict[str, torch.Tensor], losses: LossWeights) -> torch.Tensor:
    total = losses.square * parts["square"]
    for name in ("perceptual", "adversarial"):
        if name in parts:
            total = total + getattr(losses, name) * parts[name]
    return total


def _synchronised(network: nn.Module, last: bool, runs_on: Accelerator) -> Any:
    """Synchronise gradients between devices only on the last batch of a step."""
    return nullcontext() if last else runs_on.no_sync(network)


def _advance(side: Side, runs_on: Accelerator) -> None:
    if side.clip_norm:
        learning = [each for group in side.optimiser.param_groups for each in group["params"]]
        runs_on.clip_grad_norm_(learning, side.clip_norm)
    side.optimiser.step()
    side.optimiser.zero_grad()
