"""Press used to measure effects: small, so that the cost of an effect is visible."""

from __future__ import annotations

from dataclasses import dataclass

from sim.fem import Fem
from sim.indenters import sphere
from sim.scene import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, Viscosity

BODY = Body(size_x=12e-3, size_y=12e-3, thickness=4e-3)
NUMERICS = Fem(spacing=1e-3, precision="float64")
# For differences far below the usual tolerance.
EXACT = Fem(spacing=1e-3, precision="float64", tolerance=1e-10, penalty=3000.0, augmentations=10)
# Half a millimetre down, then 0.15 mm sideways, in 1 ms: fast enough for inertia to matter.
MOTION = Motion(
    ((0.0, 0.0, 0.0), (0.0, 0.0, -0.5e-3), (0.15e-3, 0.0, -0.5e-3)), (0.0, 0.5e-3, 1e-3)
)


@dataclass(frozen=True, slots=True)
class EffectScene:
    """Effect at full strength, and the fraction at which it counts as weak."""

    effect: Friction | Viscosity | Inertia | Gravity
    parameter: str
    """Parameter that goes to 0, as shown on the page at full strength."""
    fraction: float
    """Fraction of the parameter at which the response is proportional."""


TRIALS: dict[str, EffectScene] = {
    "friction": EffectScene(Friction(1.0), "coefficient 1", 1e-3),
    "viscosity": EffectScene(Viscosity((1.0, 0.5), (1e-3, 1.0)), "ratios 1 and 0.5", 1e-4),
    "inertia": EffectScene(Inertia(), "scale 1", 1e-4),
    "gravity": EffectScene(Gravity((300.0, 0.0, -500.0)), "300 and -500 m/s^2", 2e-3),
}


def scene(*names: str, fraction: float = 1.0) -> Scene:
    """Return the press with the named effects at `fraction` of their strength, all others off."""
    return Scene(sphere(3e-3), MOTION, BODY, effects(*names, fraction=fraction))


def effects(*names: str, fraction: float = 1.0) -> Effects:
    """Return the named effects at `fraction` of their strength."""
    made = {name: TRIALS[name].effect.weakened(fraction) for name in names}
    return Effects(**made)  # type: ignore[arg-type]  # each under the name of its kind
