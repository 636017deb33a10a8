"""Training settings of the diffusion translator and of its autoencoder.

Presets `paper_main` and `paper_supplement` follow the paper's two documents, `authors_code` the
published scripts, and `ours` contains our own choices.
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
    """Paths of the published weights that training starts from."""

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
    """AdamW and its learning-rate schedule."""

    rate: Constant | Cosine
    """Learning rate over the steps."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay of the running means of the gradient and its square."""
    epsilon: float = 1e-8
    """Constant added to the root of the mean square."""
    weight_decay: float = 1e-2
    """Weight decay per step, multiplied by the rate."""
    clip_norm: float = 1.0
    """Gradient norm above which gradients are clipped; 0: no clipping."""

    def __post_init__(self) -> None:
        for beta in self.betas:
            _require("betas", beta, 0, 0.999999)
        _require("epsilon", self.epsilon, 1e-12, 1.0)
        _require("weight_decay", self.weight_decay, 0, 1.0)
        _require("clip_norm", self.clip_norm, 0, 1e6)

    def of(self, parameters: Iterable[nn.Parameter]) -> torch.optim.AdamW:
        """Return the optimiser for some parameters."""
        return torch.optim.AdamW(
            list(parameters),
            lr=self.rate.at(0),
            betas=self.betas,
            eps=self.epsilon,
            weight_decay=self.weight_decay,
        )


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights in the translator's loss (the paper, eq. 5)."""

    adversarial: float = 0.5
    """Multilevel sigmoid loss of the vision-aided discriminator."""
    perceptual: float = 5.0
    """LPIPS on VGG16."""
    square: float = 1.0
    """Mean squared error of images in the network's input range."""

    def __post_init__(self) -> None:
        for name in ("adversarial", "perceptual", "square"):
            _require(f"losses.{name}", getattr(self, name), 0, 1e6)
        if self.perceptual == self.square == 0:
            raise LearningError("losses: found no reconstruction; allowed: perceptual or square")


@dataclass(frozen=True, slots=True)
class TranslatorSettings:
    """Training settings of the diffusion translator."""

    description: str
    """Source of the numbers."""
    optimiser: Optimiser
    """Settings of the generator's and the discriminator's separate optimisers."""
    losses: LossWeights = field(default_factory=LossWeights)
    """Weights of the losses."""
    weights: Weights = field(default_factory=Weights)
    """Published weights that training starts from."""
    pixel_range: Range = "minus_one_one"
    """Values of black and white for the networks, which were all trained for -1 and 1."""
    conditioning: Conditioning = "patch_tokens"
    """Encoding of references for cross-attention."""
    source_reference: bool = True
    """True if the untouched source is also an input."""
    unet_rank: int = 8
    """Rank of the UNet's adapter."""
    vae_rank: int = 4
    """Rank of the autoencoder's adapter if no trained one is given."""
    train_vae: bool = True
    """True if the autoencoder's adapter is trained, as in the paper; in the authors' code no
    optimiser updates it."""
    sample_latents: bool = True
    """True if training samples latents from the posterior; inference uses its mean."""
    two_pass: bool = False
    """True for separate passes and steps for reconstruction and adversary (authors' code); False
    for one pass and one step."""
    steps: int = 100_000
    """Steps of the generator's optimiser."""
    batch: int = 16
    """Batch size on one device, before accumulation."""
    accumulation: int = 1
    """Number of batches accumulated per step."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices and precision; the step to the clean latent and the losses are always float32."""
    gradient_checkpointing: bool = False
    """True to recompute activations instead of storing them: less memory, more time."""
    validated: int = 256
    """Largest number of validation pairs to evaluate."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    log_every: int = 25
    """Steps between lines in the log."""
    validate_every: int = 1000
    """Steps between validations."""
    seed: int = 0
    """Seed of everything random."""

    def __post_init__(self) -> None:
        _require_training(self)
        _require("unet_rank", self.unet_rank, 1, 1024)
        if self.two_pass and self.accumulation != 1:
            raise LearningError("accumulation: found more than 1; two_pass allows 1")


@dataclass(frozen=True, slots=True)
class MarkerVaeSettings:
    """Training settings of the marker autoencoder, the stage before the translator."""

    description: str
    """Source of the numbers."""
    optimiser: Optimiser
    """Optimiser of the adapter."""
    weights: Weights = field(default_factory=Weights)
    """Published weights that training starts from; only `base` is read."""
    pixel_range: Range = "minus_one_one"
    """Values of black and white for the network."""
    vae_rank: int = 4
    """Rank of the adapter."""
    absolute: float = 1.0
    """Weight of the mean absolute error."""
    square: float = 1.0
    """Weight of the mean squared error."""
    divergence: float = 1e-6
    """Weight of the posterior's divergence from the normal distribution, summed over a latent."""
    decode_scaled: bool = False
    """True if the decoder takes the latent times its scaling factor, as in the authors' code. Their
    translator decodes it unscaled."""
    steps: int = 100_000
    """Steps of the optimiser."""
    batch: int = 16
    """Batch size on one device, before accumulation."""
    accumulation: int = 1
    """Number of batches accumulated per step."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices and precision; losses are always float32."""
    gradient_checkpointing: bool = False
    """True to recompute activations instead of storing them."""
    validated: int = 256
    """Largest number of validation images to evaluate."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    log_every: int = 25
    """Steps between lines in the log."""
    validate_every: int = 1000
    """Steps between validations."""
    seed: int = 0
    """Seed of everything random."""

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
