"""Bodies and indenters of most cases."""

from __future__ import annotations

from sim.indenters import shapes
from sim.scene import Body

MM = 1e-3

# The paper's gel, 20 x 20 x 4 mm.
GEL = Body()
# Part of it that is large enough for a shear of 1 mm.
MAT = Body(size_x=14 * MM, size_y=14 * MM)
# Quarter of it, for cases about steps and not about sides.
PAD = Body(size_x=10 * MM, size_y=10 * MM)
# Model of a TacPalm: 30 x 30 x 12 mm, a dome of radius 45 mm, soft gel of 30 kPa.
DOME = Body(size_x=30 * MM, size_y=30 * MM, thickness=12 * MM, modulus=30e3, dome_radius=45 * MM)
# The same, flat.
SLAB = Body(size_x=30 * MM, size_y=30 * MM, thickness=12 * MM, modulus=30e3)

SPHERE = shapes.sphere(4 * MM)
