"""Viscosity: the material relaxes by a Prony series, in parallel with its elasticity at rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from sim.errors import SceneError, check_kind, check_range


@dataclass(frozen=True, slots=True)
class Viscosity:
    """Maxwell branches parallel to a spring: E(t) = E (1 + sum_i ratio_i exp(-t / time_i)).

    E is `Body.modulus`, the modulus at rest. Form: Simo & Hughes, Computational Inelasticity
    (1998), section 10.3, on the second Piola-Kirchhoff stress.

    Raises:
        SceneError: There is no branch or more than 4, or a value is out of range.
    """

    ratios: tuple[float, ...]
    """Ratio of each branch's stiffness to the stiffness at rest, 0 to 100."""
    times: tuple[float, ...]
    """Relaxation time of each branch [s], 1e-6 to 1e6."""
    relaxes: Literal["all", "shear"] = "all"
    """`all`: Poisson's ratio is constant in time (Lee & Radok's assumption); `shear`: the response
    to volume changes is elastic. Tier `layer` supports `all` only."""

    def __post_init__(self) -> None:
        for name in ("ratios", "times"):
            check_kind(f"viscosity.{name}", getattr(self, name), tuple | list, "a tuple of numbers")
        if not 1 <= len(self.ratios) <= 4 or len(self.ratios) != len(self.times):
            raise SceneError(
                f"viscosity: {len(self.ratios)} ratios and {len(self.times)} times; allowed: the "
                "same number of both, 1 to 4"
            )
        for index, (ratio, time) in enumerate(zip(self.ratios, self.times, strict=True)):
            check_range("viscosity", f"ratios[{index}]", ratio, 0.0, 100.0)
            check_range("viscosity", f"times[{index}]", time, 1e-6, 1e6, unit="s")
        if self.relaxes not in ("all", "shear"):
            raise SceneError(f"viscosity.relaxes: {self.relaxes!r}; allowed: 'all', 'shear'")

    def weakened(self, fraction: float) -> Viscosity:
        """Return the effect with its ratios scaled by `fraction`; at 0 it vanishes."""
        return replace(self, ratios=tuple(fraction * ratio for ratio in self.ratios))
