"""What a training of the diffusion translator is told, and of its autoencoder before it.

Presets `paper_main` and `paper_supplement` are the paper's two documents, `authors_code` what the
published scripts really do, `ours` what we would do.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from torch import nn

from learning.errors import LearningError
from learning.training.optim import Constant, Cosine
from learning.training.run import LaunchSettings
from learning.translation.diffusion.conditioning import Conditioning

TRANSLATOR_PRESETS = Path(__file__).parent / "presets" / "translator"
MARKER_VAE_PRESETS = Path(__file__).parent / "presets" / "marker_vae"
Range = Literal["minus_one_one", "zero_one"]


@dataclass(frozen=True, slots=True)
class Weights:
    """Where the published weights are that training starts from."""

    base: str = ""
    """Folder of SD-Turbo in diffusers' layout."""
    clip: str = ""
    """Folder of CLIP ViT-B/32 in transformers' layout; read if `losses.adversarial` is not 0."""
    vgg: str = ""
    """File of torchvision's VGG16; read if `losses.perceptual` is not 0."""
    lpips: str = ""
    """File of LPIPS' linear heads for VGG; read with it."""


@dataclass(frozen=True, slots=True)
class Optimiser:
    """AdamW and its learning rate over time."""

    rate: Constant | Cosine
    """Learning rate over the steps."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Of the means of gradient and square."""
    epsilon: float = 1e-8
    """Added to the root of the square."""
    weight_decay: float = 1e-2
    """Share of the weights taken off in a step, times the rate."""
    clip_norm: float = 1.0
    """Largest norm of a gradient; 0: any."""

    def __post_init__(self) -> None:
        for beta in self.betas:
            _require("betas", beta, 0, 0.999999)
        _require("epsilon", self.epsilon, 1e-12, 1.0)
        _require("weight_decay", self.weight_decay, 0, 1.0)
        _require("clip_norm", self.clip_norm, 0, 1e6)

    def of(self, parameters: Iterable[nn.Parameter]) -> torch.optim.AdamW:
        """Return the optimiser of some parameters."""
        return torch.optim.AdamW(
            list(parameters),
            lr=self.rate.at(0),
            betas=self.betas,
            eps=self.epsilon,
            weight_decay=self.weight_decay,
        )


@dataclass(frozen=True, slots=True)
class LossWeights:
    """What counts how much in the translator's loss (the paper, eq. 5)."""

    adversarial: float = 0.5
    """Multilevel sigmoid loss of the vision-aided discriminator."""
    perceptual: float = 5.0
    """LPIPS on VGG16."""
    square: float = 1.0
    """Mean square of the difference, of images in the range the network is fed."""

    def __post_init__(self) -> None:
        for name in ("adversarial", "perceptual", "square"):
            _require(f"losses.{name}", getattr(self, name), 0, 1e6)
        if self.perceptual == self.square == 0:
            raise LearningError("losses: found no reconstruction; allowed: perceptual or square")


@dataclass(frozen=True, slots=True)
class TranslatorSettings:
    """How the diffusion translator is trained."""

    description: str
    """Where the numbers come from."""
    optimiser: Optimiser
    """Of the generator and of the discriminator, one each."""
    losses: LossWeights = field(default_factory=LossWeights)
    """What counts how much."""
    weights: Weights = field(default_factory=Weights)
    """What training starts from."""
    pixel_range: Range = "minus_one_one"
    """What black and white are for the networks, all of which were made for -1 and 1."""
    conditioning: Conditioning = "patch_tokens"
    """How cross-attention sees references."""
    source_reference: bool = True
    """Whether the untouched source is seen as well."""
    unet_rank: int = 8
    """Rank of the UNet's adapter."""
    vae_rank: int = 4
    """Rank of the autoencoder's, where no trained one is given."""
    train_vae: bool = True
    """Whether the autoencoder's adapter learns. The paper says so; in the authors' code no
    optimiser holds it."""
    sample_latents: bool = True
    """Whether training draws latents from the posterior; inference takes its mean."""
    two_pass: bool = False
    """Whether reconstruction and adversary are two passes and two steps each (authors' code),
    rather than one pass, one step."""
    steps: int = 100_000
    """Steps of the generator's optimiser."""
    batch: int = 16
    """Pairs in a step on one device, before accumulation."""
    accumulation: int = 1
    """Batches in a step."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices and arithmetic; the step to the clean latent and losses are float32 in any case."""
    gradient_checkpointing: bool = False
    """Whether to compute activations again rather than keep them: less memory, more time."""
    validated: int = 256
    """Most validation pairs that are measured."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    log_every: int = 25
    """Steps between lines in the log."""
    validate_every: int = 1000
    """Steps between measurements on validation pairs."""
    seed: int = 0
    """Of everything that is drawn."""

    def __post_init__(self) -> None:
        _require_training(self)
        _require("unet_rank", self.unet_rank, 1, 1024)
        if self.two_pass and self.accumulation != 1:
            raise LearningError("accumulation: found more than 1; two_pass allows 1")


@dataclass(frozen=True, slots=True)
class MarkerVaeSettings:
    """How the autoencoder learns marker images, before the translator."""

    description: str
    """Where the numbers come from."""
    optimiser: Optimiser
    """Of the adapter."""
    weights: Weights = field(default_factory=Weights)
    """What training starts from: `base` alone is read."""
    pixel_range: Range = "minus_one_one"
    """What black and white are for the network."""
    vae_rank: int = 4
    """Rank of the adapter."""
    absolute: float = 1.0
    """What the mean absolute difference counts."""
    square: float = 1.0
    """What the mean square of the difference counts."""
    divergence: float = 1e-6
    """What the posterior's divergence from the normal distribution counts, summed over a latent."""
    decode_scaled: bool = False
    """Whether the decoder gets the latent times its scaling factor, as in the authors' code. Their
    translator decodes it unscaled."""
    steps: int = 100_000
    """Steps of the optimiser."""
    batch: int = 16
    """Images in a step on one device, before accumulation."""
    accumulation: int = 1
    """Batches in a step."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices and arithmetic; losses are float32 in any case."""
    gradient_checkpointing: bool = False
    """Whether to compute activations again rather than keep them."""
    validated: int = 256
    """Most validation images that are measured."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    log_every: int = 25
    """Steps between lines in the log."""
    validate_every: int = 1000
    """Steps between measurements on validation images."""
    seed: int = 0
    """Of everything that is drawn."""

    def __post_init__(self) -> None:
        _require_training(self)
        for name in ("absolute", "square", "divergence"):
            _require(name, getattr(self, name), 0, 1e6)


def _require_training(settings: TranslatorSettings | MarkerVaeSettings) -> None:
    _require("vae_rank", settings.vae_rank, 1, 1024)
    _require("steps", settings.steps, 1, 100_000_000)
    _require("batch", settings.batch, 1, 65_536)
    _require("accumulation", settings.accumulation, 1, 65_536)
    for name in ("checkpoint_every", "log_every", "validate_every"):
        _require(name, getattr(settings, name), 1, 100_000_000)


def _require(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise LearningError(f"{name}: found {value}; allowed: {low} to {high}")
