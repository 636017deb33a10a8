# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""From vertices to the material map: which point of the untouched gel each pixel sees.

Every cell of the grid of vertices is two triangles. First each pixel learns which triangle it sees,
the one nearest to the camera where the gel folds over; then its place within that triangle gives
the material point. The first pass keeps one number a pixel, nearness before triangle, and takes
the largest: the result does not depend on the order in which triangles come.
"""

import functools

import warp as wp

from sim.camera import HEIGHT, WIDTH
from sim.errors import SceneError
from sim.render.top import Top

NEARNESS_UNIT = 2.0**28
"""Steps of nearness in a pixel's number: finer than float32 tells; 1 is the untouched top."""
NEARNESS_MOST = 7.9
"""Larger ones are taken for this; the number keeps its sign."""
NEARNESS_BITS = wp.int64(32)
TRIANGLE_MASK = wp.int64(2**32 - 1)
CELL_BITS = 15
CELL_MASK = 2**CELL_BITS - 1
"""A pixel's number is its nearness, the cell along x, the cell along y, which of its triangles."""
NOTHING = -1
"""The number of a pixel that sees no gel."""
OVERLAP = 1e-4
"""Share of a triangle's height that a pixel's centre may lie beyond its edge: ten times what
float32 is off, so that no pixel on an edge is lost between two triangles."""
AREA_LEAST = 1e-9
"""Twice the area of what is too thin to be seen [px^2]."""
RUN = 32
"""Pixels that one thread of a CPU takes, one after the other; a GPU's takes one."""


@wp.func
def sampled(vertex: wp.vec3, samples: float):
    """A vertex with column and row counted in samples."""
    shift = 0.5 * samples - 0.5
    return wp.vec3(vertex[0] * samples + shift, vertex[1] * samples + shift, vertex[2])


@wp.func
def shares(a: wp.vec3, b: wp.vec3, c: wp.vec3, column: float, row: float):
    """Barycentric coordinates of a sample's centre; -inf or NaN in a triangle without area."""
    ab = b - a
    ac = c - a
    area = ab[0] * ac[1] - ab[1] * ac[0]
    scale = wp.where(wp.abs(area) > AREA_LEAST, 1.0 / area, wp.NAN)
    x = column - a[0]
    y = row - a[1]
    share_b = (x * ac[1] - y * ac[0]) * scale
    share_c = (ab[0] * y - ab[1] * x) * scale
    return wp.vec3(1.0 - share_b - share_c, share_b, share_c)


@wp.func
def cover_triangle(
    number: wp.array3d[wp.int64], frame: int, triangle: int, a: wp.vec3, b: wp.vec3, c: wp.vec3
):
    """Offer a triangle to every sample that it covers."""
    last_column = float(number.shape[2] - 1)
    last_row = float(number.shape[1] - 1)
    left = wp.ceil(wp.max(wp.min(wp.min(a[0], b[0]), c[0]) - OVERLAP, 0.0))
    right = wp.floor(wp.min(wp.max(wp.max(a[0], b[0]), c[0]) + OVERLAP, last_column))
    upper = wp.ceil(wp.max(wp.min(wp.min(a[1], b[1]), c[1]) - OVERLAP, 0.0))
    lower = wp.floor(wp.min(wp.max(wp.max(a[1], b[1]), c[1]) + OVERLAP, last_row))
    for row in range(int(upper), int(lower) + 1):
        for column in range(int(left), int(right) + 1):
            share = shares(a, b, c, float(column), float(row))
            if wp.min(wp.min(share[0], share[1]), share[2]) >= -OVERLAP:
                nearness = share[0] * a[2] + share[1] * b[2] + share[2] * c[2]
                level = wp.int64(wp.min(nearness, NEARNESS_MOST) * NEARNESS_UNIT)
                offer = (level << NEARNESS_BITS) | wp.int64(triangle)
                wp.atomic_max(number, frame, row, column, offer)


@functools.cache
def _cover_kernel():
    @wp.kernel(enable_backward=False, module="unique")
    def cover(
        # Settings:
        samples: float,
        # In: column, row, nearness
        vertex: wp.array3d[wp.vec3],
        # Out: what each sample sees
        number_out: wp.array3d[wp.int64],
    ):
        frame, i, j = wp.tid()
        a = sampled(vertex[frame, i, j], samples)
        b = sampled(vertex[frame, i + 1, j], samples)
        c = sampled(vertex[frame, i + 1, j + 1], samples)
        d = sampled(vertex[frame, i, j + 1], samples)
        first = ((i << CELL_BITS) | j) << 1
        cover_triangle(number_out, frame, first, a, b, c)
        cover_triangle(number_out, frame, first + 1, a, c, d)

    return cover


def see_triangles(vertex, samples: int) -> wp.array:
    """The number of what each of `samples` x `samples` samples a pixel sees (F, H, W) int64.

    Raises:
        SceneError: More cells along an axis than a number holds.
    """
    frames, x, y = vertex.shape
    if max(x, y) > CELL_MASK:
        raise SceneError(
            f"render.spacing: {x} x {y} points; allowed: up to {CELL_MASK} along each side"
        )
    shape = (frames, HEIGHT * samples, WIDTH * samples)
    number = wp.full(shape, NOTHING, dtype=wp.int64, device=vertex.device)
    wp.launch(
        _cover_kernel(),
        dim=(frames, x - 1, y - 1),
        inputs=[float(samples), vertex],
        outputs=[number],
        device=vertex.device,
    )
    return number


@functools.cache
def _material_kernel(run: int):
    @wp.kernel(enable_backward=False, module="unique")
    def find_material(
        # Settings:
        samples: float,
        corner: wp.vec2,
        step: wp.vec2,
        # In:
        vertex: wp.array3d[wp.vec3],
        number: wp.array3d[wp.int64],
        # Out: x and y of the material point; NaN where no gel is seen
        material_out: wp.array3d[wp.vec2],
    ):
        frame, row, part = wp.tid()
        for column in range(part * run, (part + 1) * run):
            found = number[frame, row, column]
            material = wp.vec2(wp.NAN, wp.NAN)
            if found >= wp.int64(0):
                triangle = int(found & TRIANGLE_MASK)
                i = triangle >> (CELL_BITS + 1)
                j = (triangle >> 1) & CELL_MASK
                second = triangle & 1
                a = sampled(vertex[frame, i, j], samples)
                b = sampled(vertex[frame, i + 1, j + second], samples)
                c = sampled(vertex[frame, i + 1 - second, j + 1], samples)
                share = shares(a, b, c, float(column), float(row))
                # What is linear in space is so over the image once it is divided by the depth.
                share_b = share[1] * b[2]
                share_c = share[2] * c[2]
                scale = 1.0 / (share[0] * a[2] + share_b + share_c)
                both = (share_b + share_c) * scale
                along_x = wp.where(second == 0, both, share_b * scale)
                along_y = wp.where(second == 0, share_c * scale, both)
                material = wp.vec2(
                    corner[0] + step[0] * (float(i) + along_x),
                    corner[1] + step[1] * (float(j) + along_y),
                )
            material_out[frame, row, column] = material

    return find_material


def find_material(top: Top, vertex, number, samples: int) -> wp.array:
    """Material point, x and y [m], that each sample sees (F, H, W) vec2; NaN for nothing."""
    material = wp.empty(number.shape, dtype=wp.vec2, device=number.device)
    run = RUN if number.device.is_cpu else 1
    frames, rows, columns = number.shape
    wp.launch(
        _material_kernel(run),
        dim=(frames, rows, columns // run),
        inputs=[float(samples), wp.vec2(*top.corner), wp.vec2(*top.step), vertex, number],
        outputs=[material],
        device=number.device,
    )
    return material
