"""Physical effects of a scene: Coulomb friction, viscosity, inertia and gravity.

Those that are off are compiled out of the kernels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from sim.errors import SceneError, check_kind, check_range


@dataclass(frozen=True, slots=True)
class Friction:
    """Coulomb friction with one coefficient for stick and slip.

    Raises:
        SceneError: The coefficient is not within 0 to 10.
    """

    coefficient: float
    """Ratio of shear traction to pressure at which a point slips, 0 to 10."""

    def __post_init__(self) -> None:
        check_range("friction", "coefficient", self.coefficient, 0.0, 10.0)

    def weakened(self, fraction: float) -> Friction:
        """Return the effect with its coefficient scaled by `fraction`; at 0 it vanishes."""
        return replace(self, coefficient=fraction * self.coefficient)


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
    times: tuple[float, ...] = field(metadata={"unit": "s"})
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


@dataclass(frozen=True, slots=True)
class Inertia:
    """Lumped mass with backward Euler: stable at any time step, damps motion it cannot resolve.

    Raises:
        SceneError: A value is out of range.
    """

    scale: float = 1.0
    """Factor on `Body.density`, 0 to 1e6: 1 is the real mass, larger is mass scaling."""

    def __post_init__(self) -> None:
        check_range("inertia", "scale", self.scale, 0.0, 1e6)

    def weakened(self, fraction: float) -> Inertia:
        """Return the effect with its mass scaled by `fraction`; at 0 it vanishes."""
        return replace(self, scale=fraction * self.scale)


@dataclass(frozen=True, slots=True)
class Gravity:
    """Constant acceleration of the body's mass; the first frame is already in equilibrium with it.

    Raises:
        SceneError: A component is not within +-1000 m/s^2.
    """

    acceleration: tuple[float, float, float] = (0.0, 0.0, -9.81)
    """Acceleration in the contact frame [m/s^2]; +9.81 in z for a sensor that faces down."""

    def __post_init__(self) -> None:
        if not isinstance(self.acceleration, tuple | list) or len(self.acceleration) != 3:
            raise SceneError(f"gravity.acceleration: {self.acceleration!r}; allowed: 3 numbers")
        for index, value in enumerate(self.acceleration):
            check_range("gravity", f"acceleration[{index}]", value, -1e3, 1e3, unit="m/s^2")

    def weakened(self, fraction: float) -> Gravity:
        """Return the effect with its acceleration scaled by `fraction`; at 0 it vanishes."""
        x, y, z = self.acceleration
        return replace(self, acceleration=(fraction * x, fraction * y, fraction * z))


KINDS = {"friction": Friction, "viscosity": Viscosity, "inertia": Inertia, "gravity": Gravity}


@dataclass(frozen=True, slots=True)
class Effects:
    """Effects beyond frictionless, quasi-static elasticity; None is off."""

    friction: Friction | None = None
    """Coulomb friction between indenter and skin."""
    viscosity: Viscosity | None = None
    """Relaxation of the material: force depends on speed, and is higher while loading."""
    inertia: Inertia | None = None
    """Mass: the body oscillates and waves propagate."""
    gravity: Gravity | None = None
    """Weight: the body sags."""

    def __post_init__(self) -> None:
        for name, kind in KINDS.items():
            allowed = f"{'an' if kind is Inertia else 'a'} {kind.__name__}"
            check_kind(f"effects.{name}", getattr(self, name), kind, allowed, optional=True)

    @property
    def key(self) -> tuple[str, ...]:
        """Names of the active effects in fixed order, used as key of the kernel cache."""
        return tuple(name for name in self.__slots__ if getattr(self, name) is not None)
