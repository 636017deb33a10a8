"""What a simulation gives: force, deformation, and how far both can be trusted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.errors import SimulationDiverged
from sim.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Quality:
    """The error every frame carries; (F,) each. NaN where a tier has no such thing."""

    residual: Array
    """Out-of-balance nodal force over contact force (l2 norms). Here and in `balance`, `fem` puts
    1e-3 E T^2 (float64: 1e-5) in place of a smaller force: 2 mN in the paper's gel."""
    contact: Array
    """Deepest penetration of a contact point over the depth of the press."""
    balance: Array
    """|force of the indenter + reaction of the base (+ weight, inertia)| over |force|."""
    energy_gap: Array
    """(Work put in - energy stored) over the most work put in so far: 0 when elastic and exact,
    what was dissipated with friction or viscosity. Work by the trapezoid rule over the steps."""
    det_f_min: Array
    """Smallest determinant of the deformation gradient; 1 untouched, 0 inverted."""
    slip_excess: Array
    """Largest |shear traction| - coefficient * pressure of a contact point, over the largest
    pressure; Coulomb's law holds where it is 0 or less. NaN without friction."""
    newton: NDArray[np.int64]
    """Newton iterations spent on the frame (contact iterations for `layer`)."""
    cg: NDArray[np.int64]
    """Conjugate-gradient iterations spent on the frame."""
    steps: NDArray[np.int64]
    """Steps the frame was cut into, failed ones counted."""


@dataclass(frozen=True, slots=True)
class Result:
    """One simulated scene: F frames, one for each waypoint of the motion.

    Everything is in the contact frame and SI units.
    """

    scene: Scene
    """What was simulated."""
    tier: str
    """`layer`, `fem` or `mpm`."""
    wrench: Array
    """Force and torque of the indenter on the body (F, 6) [N, N m], torque about the tip; pressing
    is negative Fz."""
    surface_x: Array
    """x of the material points of the top before anything touched it (X,) [m]."""
    surface_y: Array
    """The same for y (Y,) [m]."""
    surface: NDArray[np.float32]
    """Displacement of those points (F, X, Y, 3) [m]."""
    traction: NDArray[np.float32]
    """Traction of the indenter on those points (F, X, Y, 3), per untouched area [Pa]."""
    quality: Quality
    """How far each frame can be trusted."""
    record: dict[str, Any] = field(default_factory=dict)
    """What ran: tier, mesh, precision, device, effects compiled in, seconds of each stage."""

    @property
    def force(self) -> Array:
        """Force of the indenter on the body (F, 3) [N]."""
        return self.wrench[:, :3]


Outcome = Result | SimulationDiverged
"""What becomes of a scene."""
