"""Settings of a direct translator and its training; presets are in `presets/`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from learning.errors import LearningError
from learning.training.optim import Cosine
from learning.training.run import LaunchSettings
from learning.translation.direct.data import Augmentation
from learning.translation.direct.losses import LossWeights

# YAML files, one per preset.
PRESETS = Path(__file__).parent / "presets" / "translator"


@dataclass(frozen=True, slots=True)
class DirectSettings:
    """Settings of a training, apart from its data and initial weights."""

    description: str
    """Purpose of the preset."""
    widths: tuple[int, int, int] = (48, 96, 256)
    """Channels at 1/2, 1/4 and 1/8 of the side; must equal those of the initial autoencoder."""
    blocks: int = 4
    """Number of transformer blocks."""
    heads: int = 8
    """Number of attention heads; must divide the last width."""
    moving: bool = False
    """True if the decoder sees the reference's features at displaced positions."""
    pairs: Literal["supplement", "authors_code"] = "supplement"
    """Rule for pairing frames of two sensors, as in `recorder.archive`."""
    steps: int = 10_000
    """Number of optimiser steps."""
    batch: int = 128
    """Batch size over all devices."""
    learning_rate: float = 3e-4
    """Peak rate of AdamW, after warm-up; decays to 0 as a cosine."""
    warm_up: int = 500
    """Number of steps over which the learning rate rises."""
    weight_decay: float = 1e-2
    """Weight decay of AdamW."""
    clip: float = 1.0
    """Gradient norm above which gradients are clipped."""
    average: float = 0.999
    """Decay of the running average of weights per step; the average is the model."""
    losses: LossWeights = field(default_factory=LossWeights)
    """Weights of the losses."""
    discriminator_width: int = 64
    """Channels of the discriminator's first layer, if there is one."""
    augmentation: Augmentation = field(default_factory=Augmentation)
    """Augmentation of training images."""
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
        for name in ("blocks", "heads", "steps", "batch", "validate_every", "save_every"):
            if getattr(self, name) < 1:
                raise LearningError(f"{name}: found {getattr(self, name)}; allowed: 1 or more")
        if any(width < 8 or width % 8 for width in self.widths):
            raise LearningError(f"widths: found {self.widths}; allowed: multiples of 8")
        if self.widths[-1] % self.heads:
            raise LearningError(
                f"heads: found {self.heads}; allowed: divisors of {self.widths[-1]}, the last width"
            )
        if self.launch.mixed_precision == "fp16" and self.losses.adversarial:
            raise LearningError(
                "launch.mixed_precision: found fp16 with an adversary, whose gradients need a "
                "separate scale; allowed: no, bf16"
            )

    @property
    def structure(self) -> dict[str, Any]:
        """Arguments of `DirectNetwork`."""
        return {name: getattr(self, name) for name in ("widths", "blocks", "heads", "moving")}

    @property
    def schedule(self) -> Cosine:
        """Learning rate by step.

        Raises:
            LearningError: Warm-up takes all steps, or the rate is invalid.
        """
        return Cosine(self.learning_rate, self.steps, self.warm_up)
