"""Learning rates as pure functions of the step, so that resuming needs no scheduler state.

A learning rate in settings is one of these classes, selected by `kind` in YAML.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch

from learning.errors import LearningError


@dataclass(frozen=True, slots=True)
class Constant:
    """A constant rate after a warm-up from zero."""

    KIND: ClassVar[str] = "constant"

    rate: float
    warm_up: int = 0
    """Steps over which the rate rises."""

    def __post_init__(self) -> None:
        _require(self.rate, self.warm_up)

    def at(self, step: int) -> float:
        """Return the rate of a step, from 0."""
        return self.rate * _risen(step, self.warm_up)


@dataclass(frozen=True, slots=True)
class Cosine:
    """Half a cosine wave from the rate to zero."""

    KIND: ClassVar[str] = "cosine"

    rate: float
    steps: int
    """Step at which the rate reaches zero, and stays there."""
    warm_up: int = 0
    """Steps over which the rate rises; they are the first of `steps`."""

    def __post_init__(self) -> None:
        _require(self.rate, self.warm_up)
        if self.steps <= self.warm_up:
            raise LearningError(
                f"cosine: found steps {self.steps}, warm_up {self.warm_up}; allowed: more steps "
                "than warm_up"
            )

    def at(self, step: int) -> float:
        """Return the rate of a step, from 0."""
        if step < self.warm_up:
            return self.rate * _risen(step, self.warm_up)
        fraction = min(1.0, (step - self.warm_up) / (self.steps - self.warm_up))
        return self.rate * ((1 + math.cos(math.pi * fraction)) / 2)


@dataclass(frozen=True, slots=True)
class InversePower:
    """rate (1 + 3e-4 step)^-0.75, stepped every iteration (authors' code)."""

    KIND: ClassVar[str] = "inverse_power"

    rate: float
    warm_up: int = 0
    """Steps over which the rate rises."""

    def __post_init__(self) -> None:
        _require(self.rate, self.warm_up)

    def at(self, step: int) -> float:
        """Return the rate of a step, from 0."""
        fallen = float((1 + 3e-4 * step) ** -0.75)
        return self.rate * fallen * _risen(step, self.warm_up)


Schedule = Constant | Cosine | InversePower


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Set the learning rate of an optimiser, wrapped by Accelerate or not."""
    for group in optimiser.param_groups:
        group["lr"] = rate


def _risen(step: int, warm_up: int) -> float:
    return min(1.0, (step + 1) / (warm_up + 1))


def _require(rate: float, warm_up: int) -> None:
    if not (0 <= rate < math.inf and warm_up >= 0):
        raise LearningError(
            f"schedule: found rate {rate}, warm_up {warm_up}; allowed: 0 and more, finite"
        )
