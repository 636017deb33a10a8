"""The bodies and indenters that most cases press."""

from __future__ import annotations

from sim.indenters import shapes
from sim.scene import Body

MM = 1e-3

GEL = Body()
"""The paper's gel, 20 x 20 x 4 mm."""
MAT = Body(size_x=14 * MM, size_y=14 * MM)
"""As much of it as a shear of 1 mm needs."""
PAD = Body(size_x=10 * MM, size_y=10 * MM)
"""A quarter of it, for cases about steps and not about sides."""
DOME = Body(size_x=30 * MM, size_y=30 * MM, thickness=12 * MM, modulus=30e3, dome_radius=45 * MM)
"""Stands for a TacPalm: 30 x 30 x 12 mm, a dome of radius 45 mm, soft gel of 30 kPa."""
SLAB = Body(size_x=30 * MM, size_y=30 * MM, thickness=12 * MM, modulus=30e3)
"""The same, flat."""

SPHERE = shapes.sphere(4 * MM)
