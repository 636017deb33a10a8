"""Deep press of a sphere into a neo-Hookean block: converged values for comparison.

Two element families, 8-node bricks with one volume change each (60 x 60 x 12) and 27-node bricks
with full integration (16 x 16 x 4), press the same block and agree to 0.1 % in force. Contact uses
a penalty at Gauss points that is stiff enough to have no visible effect. Surface values are
accurate to about 3 um outside of the contact. Material and block are the defaults of `Body`:
W = G/2 (J^(-2/3) tr(F^T F) - 3) + K/2 ((J^2 - 1)/2 - ln J), bonded below, sides free, press in the
middle.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DeepIndentation:
    """Inputs and results of the press."""

    size_x: float
    """[m]."""
    size_y: float
    """[m]."""
    thickness: float
    """[m]."""
    modulus: float
    """[Pa]."""
    poisson: float
    radius: float
    """Radius of the rigid sphere [m]."""
    depths: tuple[float, ...]
    """[m]."""
    forces: tuple[float, ...]
    """Forces at `depths`, without friction [N]; +-0.1 %."""
    force_stick: tuple[float, float]
    """Force at the last of `depths` if touched points never slip: lowest and highest value [N]."""
    height_at: tuple[float, ...]
    """Distances from the axis, along x, of material points before the press [m]."""
    height: tuple[float, ...]
    """Their displacement upwards at the last of `depths`, without friction [m]; +-3 um."""
    outward_at: tuple[float, ...]
    """As `height_at`, for `outward` [m]."""
    outward: tuple[float, ...]
    """Their displacement away from the axis at the last of `depths`, without friction [m]."""


# Sphere R 4 mm, to 1.5 of 4 mm.
NEO_HOOKEAN_SPHERE = DeepIndentation(
    size_x=20e-3,
    size_y=20e-3,
    thickness=4e-3,
    modulus=0.145e6,
    poisson=0.45,
    radius=4e-3,
    depths=(0.5e-3, 1.0e-3, 1.5e-3),
    forces=(0.2652, 0.9197, 1.9560),
    force_stick=(2.18, 2.19),
    height_at=(4e-3, 5e-3, 6e-3, 8e-3),
    height=(0.0001e-3, 0.0439e-3, 0.0424e-3, 0.0097e-3),
    outward_at=(3e-3, 4e-3, 6e-3),
    outward=(0.0986e-3, 0.1322e-3, 0.139e-3),
)
