"""Bodies, indenters and motions of most cases; lengths of motions are in millimetres."""

from typing import Any

from sim.indenters import shapes
from sim.scene import Body, Effects, Motion, Scene, press, through

MM = 1e-3

# The paper's gel, 20 x 20 x 4 mm.
GEL = Body()
# Part of it that is large enough for a shear of 1 mm.
MAT = Body(size_x=14 * MM, size_y=14 * MM)
# Quarter of it, for cases about steps and not about sides.
PAD = Body(size_x=10 * MM, size_y=10 * MM)
SMALL = Body(size_x=8 * MM, size_y=8 * MM)
# Model of a TacPalm: 30 x 30 x 12 mm, a dome of radius 45 mm, soft gel of 30 kPa.
DOME = Body(size_x=30 * MM, size_y=30 * MM, thickness=12 * MM, modulus=30e3, dome_radius=45 * MM)

SPHERE = shapes.sphere(4 * MM)


def ball(motion: Motion, body: Body = GEL, **effects: Any) -> Scene:
    """Return a scene of the sphere of 4 mm, with these effects."""
    return Scene(SPHERE, motion, body, Effects(**effects))


def down(
    *depths: float, at: tuple[float, float] = (0.0, 0.0), shear: float = 0.0, **others: Any
) -> Motion:
    """Return the press to each depth at a place, then sheared and lifted if `shear` is not 0."""
    depths, at = tuple(depth * MM for depth in depths), (at[0] * MM, at[1] * MM)
    return press(depths, at=at, shear=shear * MM, **others)


def even(depth: float, steps: int, **others: Any) -> Motion:
    """Return the press in equal steps down to `depth`."""
    return down(*(depth * step / steps for step in range(1, steps + 1)), **others)


def way(*points: tuple[float, float, float], speed: float = 10 * MM) -> Motion:
    """Return the motion through these points."""
    return through([(x * MM, y * MM, z * MM) for x, y, z in points], speed=speed)


def begun(z: float) -> Motion:
    """Return the motion of one frame, at this height."""
    return Motion(tip=((0.0, 0.0, z * MM),), time=(0.0,))
