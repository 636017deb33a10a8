"""How an autoencoder is built and trained; presets lie beside, in `presets/`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from learning.errors import LearningError
from learning.training.launch import LaunchSettings
from learning.training.schedules import Constant, Cosine, Schedule

PRESETS = Path(__file__).parent / "presets"
"""YAML files, a preset each."""


@dataclass(frozen=True, slots=True)
class AutoencoderSettings:
    """What a training depends on, beside its data."""

    description: str
    """What the preset is for."""
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
    """Share of random patterns under made-up deformations; all of them without an archive."""
    orientation: bool = True
    """Mirror images and turn them by quarters."""
    most_images: int = 100_000
    """Of the archives, at random, that are kept in memory (64 KiB each)."""
    steps: int = 20_000
    """Of the optimiser."""
    batch: int = 64
    """Images of a step, on all devices together."""
    learning_rate: float = 3e-4
    """Of AdamW: the highest. It rises over `warm_up` steps."""
    warm_up: int = 500
    """Steps in which the learning rate rises."""
    fall: Literal["cosine", "no"] = "cosine"
    """Whether it falls to 0 towards the last step."""
    weight_decay: float = 1e-2
    """Of AdamW."""
    clip: float = 1.0
    """Largest norm of the gradient."""
    average: float = 0.999
    """Share of the running average of weights that is kept in a step; the average is the model."""
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
        for name in ("latent", "steps", "batch", "validate_every", "save_every", "most_images"):
            if getattr(self, name) < 1:
                raise LearningError(f"{name}: found {getattr(self, name)}; allowed: 1 or more")
        if any(width < 8 or width % 8 for width in self.widths):
            raise LearningError(f"widths: found {self.widths}; allowed: multiples of 8")
        if not 0 <= self.procedural <= 1:
            raise LearningError(f"procedural: found {self.procedural}; allowed: 0 to 1")

    @property
    def schedule(self) -> Schedule:
        """The learning rate by step.

        Raises:
            LearningError: As many steps to rise as there are, or a rate that is none.
        """
        if self.fall == "no":
            return Constant(self.learning_rate, self.warm_up)
        return Cosine(self.learning_rate, self.steps, self.warm_up)
