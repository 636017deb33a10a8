# mypy: ignore-errors
# Warp gives structs and functions their types itself; mypy cannot follow them.
"""The camera as Warp kernels see it."""

import math

import warp as wp

from sim.camera import Camera
from sim.camera.camera import MIDDLE


@wp.struct
class Lens:
    """A `sim.camera.Camera`: lengths in m and px, the turn as cosine and sine."""

    focal: float
    distance: float
    cosine: float
    sine: float
    column: float
    row: float


def lens_of(camera: Camera) -> Lens:
    """The struct with a camera's numbers."""
    lens = Lens()
    lens.focal, lens.distance = camera.focal, camera.distance
    lens.cosine, lens.sine = math.cos(camera.rotation), math.sin(camera.rotation)
    lens.column = MIDDLE[0] + camera.shift[0]
    lens.row = MIDDLE[1] + camera.shift[1]
    return lens


@wp.func
def seen(lens: Lens, place: wp.vec3):
    """Column and row at which a place [m] is seen, and the camera's distance over its depth.

    The third is 1 in the plane of the untouched top, larger nearer to the camera, and, unlike the
    depth, linear over the image of a plane.
    """
    nearness = lens.distance / (lens.distance + place[2])
    scale = lens.focal / lens.distance * nearness
    x = scale * place[0]
    y = scale * place[1]
    return wp.vec3(
        lens.column + lens.cosine * x - lens.sine * y,
        lens.row - lens.sine * x - lens.cosine * y,
        nearness,
    )
