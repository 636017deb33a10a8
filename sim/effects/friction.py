"""Coulomb friction: at every contact point, shear traction is at most mu times the pressure."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from sim.effects.declaration import Memory, Snippet
from sim.errors import check_range


@dataclass(frozen=True, slots=True)
class Friction:
    """Coulomb friction with one coefficient for stick and slip.

    Raises:
        SceneError: The coefficient is not within 0 to 10.
    """

    STATE: ClassVar[tuple[Memory, ...]] = (
        Memory("traction", "contact point", 3),
        Memory("traction_old", "contact point", 3),
        Memory("limit", "contact point", 1),
        Memory("_limit_relaxed", "contact point", 1),
    )
    KERNELS: ClassVar[tuple[Snippet, ...]] = (
        Snippet("sim.fem.contact", "contact_kernels", "friction"),
        Snippet("sim.fem.vectors", "work_kernel", "friction"),
        Snippet("sim.fem.reading", "reading_kernels", "friction"),
    )
    LIMIT: ClassVar[str] = "coefficient -> 0: frictionless contact"

    coefficient: float
    """Ratio of shear traction to pressure at which a point slips, 0 to 10."""

    def __post_init__(self) -> None:
        check_range("friction", "coefficient", self.coefficient, 0.0, 10.0)

    def weakened(self, fraction: float) -> Friction:
        """Return the effect with its coefficient scaled by `fraction`; at 0 it vanishes."""
        return replace(self, coefficient=fraction * self.coefficient)
