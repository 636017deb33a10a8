# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""The displacement that the camera sees, on a lattice of the untouched image.

What the untouched gel shows at pixel p is seen at p + d(p). d is kept instead of images: whatever
the pattern, its image follows.
"""

import functools

import numpy as np
import warp as wp

from recorder.markers import Lattice
from sim.body import Body
from sim.camera import Camera
from sim.render.cubic import Taps
from sim.render.lens import Lens, seen
from sim.render.top import heights
from sim.render.vertices import moved_by, tap_arrays


def seen_places(lattice: Lattice, camera: Camera, body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Place and height (n, 3) [m] of the material points that places see, and which places (R, C).

    Places that see no gel are left out.
    """
    pixels = np.stack(np.meshgrid(lattice.columns, lattice.rows), axis=-1)
    places = camera.places(pixels, body)
    with np.errstate(invalid="ignore"):
        on_gel = (np.abs(places) <= np.array([body.size_x, body.size_y]) / 2).all(axis=-1)
    x, y = places[on_gel].T
    return np.stack([x, y, heights(body, x, y)], axis=1), on_gel


@functools.cache
def _displacement_kernel():
    @wp.kernel(enable_backward=False, module="unique")
    def displacement(
        # Settings:
        lens: Lens,
        # Places:
        place: wp.array[wp.vec3],
        first_x: wp.array[int],
        weight_x: wp.array[wp.vec4],
        first_y: wp.array[int],
        weight_y: wp.array[wp.vec4],
        # In:
        surface: wp.array3d[wp.vec3],
        # Out: columns and rows that each place moved
        displacement_out: wp.array2d[wp.vec2],
    ):
        frame, k = wp.tid()
        moved = moved_by(surface, frame, first_x[k], first_y[k], weight_x[k], weight_y[k])
        before = seen(lens, place[k])
        after = seen(lens, place[k] + moved)
        displacement_out[frame, k] = wp.vec2(after[0] - before[0], after[1] - before[1])

    return displacement


def displacements(lens: Lens, places: np.ndarray, taps_x: Taps, taps_y: Taps, surface) -> wp.array:
    """How far (F, n) vec2 [px] the images of material points moved; taps are one a point."""
    device = surface.device
    out = wp.empty((surface.shape[0], len(places)), dtype=wp.vec2, device=device)
    on_device = wp.array(places.astype(np.float32), dtype=wp.vec3, device=device)
    wp.launch(
        _displacement_kernel(),
        dim=out.shape,
        inputs=[lens, on_device, *tap_arrays((taps_x, taps_y), device), surface],
        outputs=[out],
        device=device,
    )
    return out
