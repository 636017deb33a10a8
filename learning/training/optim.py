"""Weights averaged over the steps of a training, and learning rates by step."""

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
    """An exponential moving average of a module's parameters; other state is taken as it is.

    Until it has seen many steps it averages over those that there were: the n-th counts
    1 - min(decay, (1 + n) / (10 + n)).
    """

    def __init__(self, module: nn.Module, decay: float = 0.999) -> None:
        """Begin with the module's weights.

        Args:
            module: What is averaged; not wrapped by Accelerate.
            decay: Share of the average that a step leaves, 0 to less than 1.

        Raises:
            LearningError: Another decay.
        """
        if not 0 <= decay < 1:
            raise LearningError(f"ema: found decay {decay}; allowed: 0 to less than 1")
        self.decay = decay
        self._updates = 0
        self._average = {name: value.detach().clone() for name, value in _state(module).items()}
        self._parameters = {name for name, _ in module.named_parameters()}

    @torch.no_grad()
    def update(self, module: nn.Module) -> None:
        """Take in the weights after a step."""
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
        """Let a module have the average while the context is open."""
        own = {name: value.detach().clone() for name, value in _state(module).items()}
        module.load_state_dict(self._average)
        try:
            yield
        finally:
            module.load_state_dict(own)

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint keeps."""
        return {"decay": self.decay, "updates": self._updates, "average": self._average}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with what `state_dict` gave.

        Raises:
            LearningError: It is of another module or decay.
        """
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


# Learning rates as pure functions of the step: resuming needs no scheduler's state.
#
# A rate of settings is one of these; `kind` in YAML says which.


@dataclass(frozen=True, slots=True)
class Constant:
    """One rate, after it rose from nothing."""

    KIND: ClassVar[str] = "constant"

    rate: float
    warm_up: int = 0
    """Steps over which the rate rises."""

    def __post_init__(self) -> None:
        _require(self.rate, self.warm_up)

    def at(self, step: int, steps_per_epoch: int = 1) -> float:
        """Return the rate of a step, from 0."""
        return self.rate * _risen(step, self.warm_up)


@dataclass(frozen=True, slots=True)
class Cosine:
    """Half a wave of a cosine from the rate to a share of it."""

    KIND: ClassVar[str] = "cosine"

    rate: float
    steps: int
    """The rate has arrived at its end after so many, and stays there."""
    warm_up: int = 0
    """Steps over which the rate rises; they are the first of `steps`."""
    final: float = 0.0
    """Share of the rate at the end."""

    def __post_init__(self) -> None:
        _require(self.rate, self.warm_up)
        if self.steps <= self.warm_up or not 0 <= self.final <= 1:
            raise LearningError(
                f"cosine: found steps {self.steps}, warm_up {self.warm_up}, final {self.final}; "
                "allowed: more steps than warm_up, final 0 to 1"
            )

    def at(self, step: int, steps_per_epoch: int = 1) -> float:
        """Return the rate of a step, from 0."""
        if step < self.warm_up:
            return self.rate * _risen(step, self.warm_up)
        share = min(1.0, (step - self.warm_up) / (self.steps - self.warm_up))
        wave = (1 + math.cos(math.pi * share)) / 2
        return self.rate * (self.final + (1 - self.final) * wave)


@dataclass(frozen=True, slots=True)
class Stages:
    """A rate for some epochs, then the next: 0.1 for 40, 1e-3 for 40 (the paper, Methods)."""

    KIND: ClassVar[str] = "stages"

    rates: tuple[float, ...] = (0.1, 1e-3)
    epochs: tuple[int, ...] = (40, 40)
    """How long each rate lasts; the last one goes on."""

    def __post_init__(self) -> None:
        for rate in self.rates:
            _require(rate, 0)
        if not self.rates or len(self.rates) != len(self.epochs) or min(self.epochs) < 1:
            raise LearningError(
                f"stages: found rates {self.rates}, epochs {self.epochs}; allowed: as many of "
                "each, 1 epoch or more"
            )

    def at(self, step: int, steps_per_epoch: int = 1) -> float:
        """Return the rate of a step, from 0."""
        epoch, end = step // steps_per_epoch, 0
        for rate, epochs in zip(self.rates, self.epochs, strict=True):
            end += epochs
            if epoch < end:
                return rate
        return self.rates[-1]


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

    def at(self, step: int, steps_per_epoch: int = 1) -> float:
        """Return the rate of a step, from 0."""
        fallen = float((1 + self.gamma * step) ** -self.power)
        return self.rate * fallen * _risen(step, self.warm_up)


Schedule = Constant | Cosine | Stages | InversePower


def set_rate(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Let an optimiser, wrapped by Accelerate or not, take its next step at a rate."""
    for group in optimiser.param_groups:
        group["lr"] = rate


def _risen(step: int, warm_up: int) -> float:
    return min(1.0, (step + 1) / (warm_up + 1))


def _require(rate: float, warm_up: int) -> None:
    if not (0 <= rate < math.inf and warm_up >= 0):
        raise LearningError(
            f"schedule: found rate {rate}, warm_up {warm_up}; allowed: 0 and more, finite"
        )
