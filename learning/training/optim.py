"""Learning rates as pure functions of the step, so that resuming needs no scheduler state.

A learning rate in settings is one of these classes, selected by `kind` in YAML.
"""

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch

from learning.errors import LearningError


@dataclass(frozen=True)
class Constant:
    """A constant rate after a warm-up from zero."""

    KIND: ClassVar[str] = "constant"

    rate: float
    warm_up: int = 0
    """Steps over which the rate rises."""

    def __post_init__(self) -> None:
        if not (0 <= self.rate < math.inf and self.warm_up >= 0):
            raise LearningError(
                f"schedule: found rate {self.rate}, warm_up {self.warm_up}; allowed: 0 and more, "
                "finite"
            )

    def at(self, step: int) -> float:
        """Return the rate of a step, from 0."""
        return self.rate * min(1.0, (step + 1) / (self.warm_up + 1))


@dataclass(frozen=True)
class Cosine(Constant):
    """Half a cosine wave from the rate to zero; the warm-up is the first of its steps."""

    KIND: ClassVar[str] = "cosine"

    steps: int = field(kw_only=True)
    """Step at which the rate reaches zero, and stays there."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps <= self.warm_up:
            raise LearningError(
                f"cosine: found steps {self.steps}, warm_up {self.warm_up}; allowed: more steps "
                "than warm_up"
            )

    def at(self, step: int) -> float:
        """Return the rate of a step, from 0."""
        fraction = min(1.0, (step - self.warm_up) / (self.steps - self.warm_up))
        falling = (1 + math.cos(math.pi * max(0.0, fraction))) / 2
        return super().at(step) * falling


@dataclass(frozen=True)
class InversePower(Constant):
    """rate (1 + 3e-4 step)^-0.75, stepped every iteration (authors' code)."""

    KIND: ClassVar[str] = "inverse_power"

    def at(self, step: int) -> float:
        """Return the rate of a step, from 0."""
        return super().at(step) * float((1 + 3e-4 * step) ** -0.75)


Schedule = Constant | Cosine | InversePower


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of an optimiser, wrapped by Accelerate or not."""
    for group in optimiser.param_groups:
        group["lr"] = rate
