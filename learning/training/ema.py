"""Weights averaged over the steps of a training: they vary less than those of its last one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

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
