"""How a direct translator is built and trained; presets lie beside, in `presets/`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from learning.errors import LearningError
from learning.training.optim import Cosine
from learning.training.run import LaunchSettings
from learning.translation.direct.data import Augmentation
from learning.translation.direct.losses import LossWeights

# YAML files, a preset each.
PRESETS = Path(__file__).parent / "presets" / "translator"


@dataclass(frozen=True, slots=True)
class DirectSettings:
    """What a training depends on, beside its data and the weights it starts from."""

    description: str
    """What the preset is for."""
    widths: tuple[int, int, int] = (48, 96, 256)
    """Channels at 1/2, 1/4 and 1/8 of the side: those of the autoencoder it starts from."""
    blocks: int = 4
    """Transformer blocks."""
    heads: int = 8
    """Of their attention; divides the last width."""
    moving: bool = False
    """Whether the decoder sees the reference's features where they went, else where they were."""
    pairs: Literal["supplement", "authors_code"] = "supplement"
    """Which frames of two sensors belong together, as in `recorder.archive`."""
    steps: int = 10_000
    """Of the optimiser."""
    batch: int = 128
    """Samples of a step, on all devices together."""
    learning_rate: float = 3e-4
    """Of AdamW, after warming up; falls to 0 as a cosine."""
    warm_up: int = 500
    """Steps in which the learning rate rises."""
    weight_decay: float = 1e-2
    """Of AdamW."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    average: float = 0.999
    """Share of the running average of weights that is kept in a step; the average is the model."""
    losses: LossWeights = field(default_factory=LossWeights)
    """What images are judged by."""
    discriminator_width: int = 64
    """Channels of its first layer, if there is one."""
    augmentation: Augmentation = field(default_factory=Augmentation)
    """What is done to training images."""
    seed: int = 0
    """Of everything random."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Where it runs, and what the network computes in."""
    validate_every: int = 500
    """Steps from one validation to the next."""
    validation_images: int = 512
    """Most images of a validation."""
    save_every: int = 1000
    """Steps from one checkpoint to the next."""

    def __post_init__(self) -> None:
        for name in ("blocks", "heads", "steps", "batch", "validate_every", "save_every"):
            if getattr(self, name) < 1:
                raise LearningError(f"{name}: found {getattr(self, name)}; allowed: 1 or more")
        if any(width < 8 or width % 8 for width in self.widths):
            raise LearningError(f"widths: found {self.widths}; allowed: multiples of 8")
        if self.widths[-1] % self.heads:
            raise LearningError(
                f"heads: found {self.heads}; allowed: what divides widths, here {self.widths[-1]}"
            )
        if self.launch.mixed_precision == "fp16" and self.losses.adversarial:
            raise LearningError(
                "launch.mixed_precision: found fp16 with an adversary, whose gradients need a "
                "scale of their own; allowed: no, bf16"
            )

    @property
    def structure(self) -> dict[str, Any]:
        """What the network is built of: the arguments of `DirectNetwork`."""
        return {name: getattr(self, name) for name in ("widths", "blocks", "heads", "moving")}

    @property
    def schedule(self) -> Cosine:
        """The learning rate by step.

        Raises:
            LearningError: As many steps to rise as there are, or a rate that is none.
        """
        return Cosine(self.learning_rate, self.steps, self.warm_up)
