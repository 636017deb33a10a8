"""Exponential moving average of weights, and learning-rate schedules."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from learning.errors import LearningError


class Ema:
    """An exponential moving average of a module's parameters; other state is copied.

    The decay is reduced in the first steps: after n updates it is min(decay, (1 + n) / (10 + n)).
    """

    def __init__(self, module: nn.Module, decay: float = 0.999) -> None:
        """Begin with the module's weights.

        Args:
            module: The module to average; not wrapped by Accelerate.
            decay: Fraction of the average that an update keeps, 0 to less than 1.
        """
        if not 0 <= decay < 1:
            raise LearningError(f"ema: found decay {decay}; allowed: 0 to less than 1")
        self.decay = decay
        self._updates = 0
        self._average = {name: value.detach().clone() for name, value in _state(module).items()}
        self._parameters = {name for name, _ in module.named_parameters()}

    @torch.no_grad()
    def update(self, module: nn.Module) -> None:
        """Update the average after a step."""
        self._updates += 1
        left = min(self.decay, (1 + self._updates) / (10 + self._updates))
        for name, value in _state(module).items():
            kept = self._average[name]
            if name in self._parameters and kept.is_floating_point():
                kept.lerp_(value.detach().to(kept.dtype), 1 - left)
            else:
                kept.copy_(value)

    @property
    def weights(self) -> Mapping[str, Tensor]:
        """The average, by the names of the module's state."""
        return self._average

    @contextmanager
    def applied(self, module: nn.Module) -> Iterator[None]:
        """Give a module the averaged weights while the context is open."""
        own = {name: value.detach().clone() for name, value in _state(module).items()}
        module.load_state_dict(self._average)
        try:
            yield
        finally:
            module.load_state_dict(own)

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint."""
        return {"decay": self.decay, "updates": self._updates, "average": self._average}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the state from `state_dict`."""
        average = state["average"]
        shapes = {name: tuple(value.shape) for name, value in average.items()}
        own = {name: tuple(value.shape) for name, value in self._average.items()}
        if shapes != own or state["decay"] != self.decay:
            raise LearningError(
                "ema: found an average of another module or decay; allowed: its own"
            )
        self._updates = int(state["updates"])
        for name, value in average.items():
            self._average[name].copy_(value)


def _state(module: nn.Module) -> dict[str, Tensor]:
    return dict(module.state_dict())


# Learning rates as pure functions of the step, so that resuming needs no scheduler state.
#
# A learning rate in settings is one of these classes, selected by `kind` in YAML.


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
    """Half a cosine wave from the rate to a fraction of it."""

    KIND: ClassVar[str] = "cosine"

    rate: float
    steps: int
    """Step at which the rate reaches its final value, and stays there."""
    warm_up: int = 0
    """Steps over which the rate rises; they are the first of `steps`."""
    final: float = 0.0
    """Fraction of the rate at the end."""

    def __post_init__(self) -> None:
        _require(self.rate, self.warm_up)
        if self.steps <= self.warm_up or not 0 <= self.final <= 1:
            raise LearningError(
                f"cosine: found steps {self.steps}, warm_up {self.warm_up}, final {self.final}; "
                "allowed: more steps than warm_up, final 0 to 1"
            )

    def at(self, step: int) -> float:
        """Return the rate of a step, from 0."""
        if step < self.warm_up:
            return self.rate * _risen(step, self.warm_up)
        fraction = min(1.0, (step - self.warm_up) / (self.steps - self.warm_up))
        wave = (1 + math.cos(math.pi * fraction)) / 2
        return self.rate * (self.final + (1 - self.final) * wave)


@dataclass(frozen=True, slots=True)
class InversePower:
    """rate (1 + gamma step)^-power (authors' code: 3e-4 and 0.75, stepped every iteration)."""

    KIND: ClassVar[str] = "inverse_power"

    rate: float
    gamma: float = 3e-4
    power: float = 0.75
    warm_up: int = 0
    """Steps over which the rate rises."""

    def __post_init__(self) -> None:
        _require(self.rate, self.warm_up)
        if self.gamma < 0 or self.power < 0:
            raise LearningError(
                f"inverse_power: found gamma {self.gamma}, power {self.power}; allowed: 0 and more"
            )

    def at(self, step: int) -> float:
        """Return the rate of a step, from 0."""
        fallen = float((1 + self.gamma * step) ** -self.power)
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
