"""What a relaxing layer remembers: the stress in its Maxwell branches, pixel by pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.effects import Viscosity

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Relaxed:
    """How a step's traction follows from its elastic part: factor * elastic + held."""

    factor: float
    held: Array
    """(3, X, Y) [Pa]."""
    kept: tuple[float, ...]
    """What is left of each branch's stress after the step, of 1."""
    gained: tuple[float, ...]
    """What each branch takes up of a change in the elastic part."""


class History:
    """Tractions of a layer whose relaxation is the same for all deformations.

    With E(t) = E (1 + sum_i ratio_i exp(-t / time_i)) and a constant Poisson's ratio, the traction
    is that of the elastic layer with the present displacement, `elastic`, and for each branch the
    convolution of its change with ratio_i exp(-t / time_i). `elastic` changes evenly within a
    step, for which the convolution is exact (Taylor, Pister & Goudreau, Int. J. Numer. Meth. Eng. 2
    (1970) 45).
    """

    def __init__(self, viscosity: Viscosity | None, shape: tuple[int, int]) -> None:
        """Begin at rest and untouched; without viscosity there is nothing to remember."""
        self._ratios = viscosity.ratios if viscosity else ()
        self._times = viscosity.times if viscosity else ()
        self.elastic: Array = np.zeros((3, *shape))
        """Traction that the elastic layer would need for the present displacement [Pa]."""
        self._tractions: list[Array] = [np.zeros((3, *shape)) for _ in self._ratios]

    def after(self, duration: float) -> Relaxed:
        """How the traction follows from the elastic part after `duration` [s]; 0 is a jump."""
        spans = [duration / time for time in self._times]
        kept = tuple(math.exp(-span) for span in spans)
        gained = tuple(
            ratio * (-math.expm1(-span) / span if span > 0 else 1.0)
            for ratio, span in zip(self._ratios, spans, strict=True)
        )
        held = np.zeros_like(self.elastic) - sum(gained) * self.elastic
        for share, branch in zip(kept, self._tractions, strict=True):
            held += share * branch
        return Relaxed(1 + sum(gained), held, kept, gained)

    def take(self, step: Relaxed, elastic: Array) -> None:
        """End a step with this elastic part."""
        change = elastic - self.elastic
        self._tractions = [
            share * branch + gain * change
            for share, gain, branch in zip(step.kept, step.gained, self._tractions, strict=True)
        ]
        self.elastic = elastic

    def branches(self) -> list[tuple[float, Array]]:
        """Stiffness over that at rest, and traction [Pa], of every branch that has any."""
        return [
            (ratio, traction)
            for ratio, traction in zip(self._ratios, self._tractions, strict=True)
            if ratio > 0
        ]
