"""Press used to measure effects: small, so that the cost of an effect is visible."""

from __future__ import annotations

from dataclasses import dataclass

from sim.fem import Fem
from sim.indenters import sphere
from sim.scene import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, Viscosity

BODY = Body(size_x=12e-3, size_y=12e-3, thickness=4e-3)
NUMERICS = Fem(spacing=1e-3, precision="float64")
# Half a millimetre down, then 0.15 mm sideways, in 1 ms: fast enough for inertia to matter.
MOTION = Motion(
    ((0.0, 0.0, 0.0), (0.0, 0.0, -0.5e-3), (0.15e-3, 0.0, -0.5e-3)), (0.0, 0.5e-3, 1e-3)
)


@dataclass(frozen=True, slots=True)
class Trial:
    """An effect, and its strength in words."""

    effect: Friction | Viscosity | Inertia | Gravity
    strength: str


TRIALS: dict[str, Trial] = {
    "friction": Trial(Friction(1.0), "coefficient 1"),
    "viscosity": Trial(Viscosity((1.0, 0.5), (1e-3, 1.0)), "ratios 1 and 0.5"),
    "inertia": Trial(Inertia(), "scale 1"),
    "gravity": Trial(Gravity((300.0, 0.0, -500.0)), "300 and -500 m/s^2"),
}


def scene(*names: str) -> Scene:
    """Return the press with the named effects, all others off."""
    effects = Effects(**{name: TRIALS[name].effect for name in names})  # type: ignore[arg-type]
    return Scene(sphere(3e-3), MOTION, BODY, effects)
