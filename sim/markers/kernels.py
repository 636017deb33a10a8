# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""What the camera sees, pixel by pixel, as Warp kernels: the gel, its markers, their motion."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from recorder.markers import Lattice
from sim.errors import SceneError
from sim.markers.camera import HEIGHT, MIDDLE, WIDTH, Camera
from sim.markers.textures import Textures
from sim.markers.top import TAPS, Taps, Top, heights
from sim.scene import Body


@wp.struct
class Lens:
    """A `sim.markers.Camera`: lengths in m and px, the turn as cosine and sine."""

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


# From vertices to the material map: which point of the untouched gel each pixel sees.
#
# Every cell of the grid of vertices is two triangles. First each pixel learns which triangle it
# sees, the one nearest to the camera where the gel folds over; then its place within that triangle
# gives the material point. The first pass keeps one number a pixel, nearness before triangle, and
# takes the largest: the result does not depend on the order in which triangles come.

# Steps of nearness in a pixel's number: finer than float32 tells; 1 is the untouched top.
NEARNESS_UNIT = 2.0**28
# Larger ones are taken for this; the number keeps its sign.
NEARNESS_MOST = 7.9
NEARNESS_BITS = wp.int64(32)
TRIANGLE_MASK = wp.int64(2**32 - 1)
CELL_BITS = 15
# A pixel's number is its nearness, the cell along x, the cell along y, which of its triangles.
CELL_MASK = 2**CELL_BITS - 1
# The number of a pixel that sees no gel.
NOTHING = -1
# Share of a triangle's height that a pixel's centre may lie beyond its edge: ten times what float32
# is off, so that no pixel on an edge is lost between two triangles.
OVERLAP = 1e-4
# Twice the area of what is too thin to be seen [px^2].
AREA_LEAST = 1e-9
# Pixels that one thread of a CPU takes, one after the other; a GPU's takes one.
RUN = 32


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


# From the material map to images: which pixels, or which share of each, a marker covers.
#
# A straight edge covers half of a pixel exactly when the pixel's centre lies on it. So a pixel is
# marker (at least half of it) where the signed distance at its centre is not above 0: anti-aliased,
# then thresholded, to first order in the size of a pixel. Several samples a pixel count the share
# that is covered instead; bent edges and corners are then as exact as the samples are fine.

# Pixels in a byte of a packed mask.
BITS = 8
# Change of the distance from pixel to pixel below which there is no edge [m].
FLAT = 1e-12


@wp.func
def distance_at(
    values: wp.array3d[float], pattern: int, corner: wp.vec2, density: float, place: wp.vec2
):
    """Signed distance to a marker's edge [m] at a material point; far from all where NaN.

    `density` is the number of values a metre.
    """
    if wp.isnan(place[0]):
        return wp.inf
    last_row = values.shape[1] - 1
    last_column = values.shape[2] - 1
    x = wp.clamp((place[0] - corner[0]) * density, 0.0, float(last_column))
    y = wp.clamp((place[1] - corner[1]) * density, 0.0, float(last_row))
    column = wp.min(int(x), last_column - 1)
    row = wp.min(int(y), last_row - 1)
    right = x - float(column)
    up = y - float(row)
    low = wp.lerp(values[pattern, row, column], values[pattern, row, column + 1], right)
    high = wp.lerp(values[pattern, row + 1, column], values[pattern, row + 1, column + 1], right)
    return wp.lerp(low, high, up)


@wp.func
def covered(
    material: wp.array3d[wp.vec2],
    frame: int,
    row: int,
    column: int,
    samples: int,
    values: wp.array3d[float],
    pattern: int,
    corner: wp.vec2,
    density: float,
):
    """How many of a pixel's samples a marker covers."""
    count = wp.int32(0)
    for r in range(samples):
        for c in range(samples):
            place = material[frame, row * samples + r, column * samples + c]
            if distance_at(values, pattern, corner, density, place) <= 0.0:
                count += 1
    return count


@functools.cache
def _mask_kernel(several: bool):
    @wp.kernel(enable_backward=False, module="unique")
    def pack(
        # Settings:
        samples: int,
        corner: wp.vec2,
        density: float,
        # In:
        values: wp.array3d[float],
        material: wp.array3d[wp.vec2],
        # Out: eight pixels a byte, the first in the highest bit
        packed_out: wp.array3d[wp.uint8],
    ):
        frame, pattern, byte = wp.tid()
        row = byte * BITS // WIDTH
        first = byte * BITS % WIDTH
        bits = wp.int32(0)
        if wp.static(not several):
            middle = material[frame, row, first + BITS // 2]
            far = distance_at(values, pattern, corner, density, middle)
            for k in range(BITS):
                place = material[frame, row, first + k]
                here = far
                # Bilinear between distances, it changes by sqrt 2 times the way at most.
                if not 2.0 * wp.length_sq(place - middle) < far * far:
                    here = distance_at(values, pattern, corner, density, place)
                bits = 2 * bits + wp.where(here <= 0.0, 1, 0)
        else:
            for k in range(BITS):
                count = covered(
                    material, frame, row, first + k, samples, values, pattern, corner, density
                )
                bits = 2 * bits + wp.where(2 * count >= samples * samples, 1, 0)
        packed_out[frame, pattern, byte] = wp.uint8(bits)

    return pack


def packed_masks(material, samples: int, textures: Textures) -> wp.array:
    """Packed masks (F, P, H W / 8) uint8 of every frame and pattern."""
    shape = (material.shape[0], len(textures), HEIGHT * WIDTH // BITS)
    packed = wp.empty(shape, dtype=wp.uint8, device=material.device)
    wp.launch(
        _mask_kernel(samples > 1),
        dim=shape,
        inputs=[samples, textures.corner, 1.0 / textures.step, textures.values, material],
        outputs=[packed],
        device=material.device,
    )
    return packed


@wp.func
def distance_beside(
    material: wp.array3d[wp.vec2],
    frame: int,
    row: int,
    column: int,
    values: wp.array3d[float],
    pattern: int,
    corner: wp.vec2,
    density: float,
    instead: float,
):
    """Distance at a pixel; `instead` where there is no pixel or it sees no gel."""
    if row < 0 or row >= material.shape[1] or column < 0 or column >= material.shape[2]:
        return instead
    place = material[frame, row, column]
    if wp.isnan(place[0]):
        return instead
    return distance_at(values, pattern, corner, density, place)


@functools.cache
def _coverage_kernel(several: bool):
    @wp.kernel(enable_backward=False, module="unique")
    def cover(
        # Settings:
        samples: int,
        corner: wp.vec2,
        density: float,
        # In:
        values: wp.array3d[float],
        material: wp.array3d[wp.vec2],
        # Out: 255 where all of a pixel is marker
        coverage_out: wp.array4d[wp.uint8],
    ):
        frame, pattern, row, column = wp.tid()
        share = wp.float32(0.0)
        if wp.static(several):
            count = covered(material, frame, row, column, samples, values, pattern, corner, density)
            share = float(count) / float(samples * samples)
        else:
            here = distance_at(values, pattern, corner, density, material[frame, row, column])
            if wp.isfinite(here):
                left = distance_beside(
                    material, frame, row, column - 1, values, pattern, corner, density, here
                )
                right = distance_beside(
                    material, frame, row, column + 1, values, pattern, corner, density, here
                )
                above = distance_beside(
                    material, frame, row - 1, column, values, pattern, corner, density, here
                )
                below = distance_beside(
                    material, frame, row + 1, column, values, pattern, corner, density, here
                )
                change = wp.length(wp.vec2(right - left, below - above)) * 0.5
                share = wp.where(here <= 0.0, 1.0, 0.0)
                if change > FLAT:
                    share = wp.clamp(0.5 - here / change, 0.0, 1.0)
        coverage_out[frame, pattern, row, column] = wp.uint8(share * 255.0 + 0.5)

    return cover


def coverages(material, samples: int, textures: Textures) -> wp.array:
    """Share of each pixel that markers cover (F, P, H, W) uint8, 255 for all of it."""
    shape = (material.shape[0], len(textures), HEIGHT, WIDTH)
    coverage = wp.empty(shape, dtype=wp.uint8, device=material.device)
    wp.launch(
        _coverage_kernel(samples > 1),
        dim=shape,
        inputs=[samples, textures.corner, 1.0 / textures.step, textures.values, material],
        outputs=[coverage],
        device=material.device,
    )
    return coverage


# Where the camera sees the material points of the top: (frame, x, y) -> column, row, nearness.


@dataclass(frozen=True, slots=True)
class DeviceTop:
    """A `Top` on a device."""

    x: wp.array
    y: wp.array
    height: wp.array

    @classmethod
    def of(cls, top: Top, device):
        """Copy it there."""
        values = (top.x, top.y, top.height)
        return cls(*(wp.array(value.astype(np.float32), device=device) for value in values))


@wp.func
def moved_by(
    surface: wp.array3d[wp.vec3],
    frame: int,
    first_x: int,
    first_y: int,
    weight_x: wp.vec4,
    weight_y: wp.vec4,
):
    """Displacement at a place, from the four by four values around it."""
    total = wp.vec3()
    for a in range(wp.static(TAPS)):
        along = wp.vec3()
        for b in range(wp.static(TAPS)):
            along += surface[frame, first_x + a, first_y + b] * weight_y[b]
        total += along * weight_x[a]
    return total


@functools.cache
def _kernel():
    @wp.kernel(enable_backward=False, module="unique")
    def vertices(
        # Settings:
        lens: Lens,
        # Untouched top:
        x: wp.array[float],
        y: wp.array[float],
        height: wp.array2d[float],
        # Taps along x and y:
        first_x: wp.array[int],
        weight_x: wp.array[wp.vec4],
        first_y: wp.array[int],
        weight_y: wp.array[wp.vec4],
        # In: displacement
        surface: wp.array3d[wp.vec3],
        # Out: column, row, nearness
        vertex_out: wp.array3d[wp.vec3],
    ):
        frame, i, j = wp.tid()
        moved = moved_by(surface, frame, first_x[i], first_y[j], weight_x[i], weight_y[j])
        vertex_out[frame, i, j] = seen(lens, wp.vec3(x[i], y[j], height[i, j]) + moved)

    return vertices


def tap_arrays(axes: Sequence[Taps], device) -> list[wp.array]:
    """First values and weights of each axis in turn, on the device."""
    return [
        wp.array(values, dtype=kind, device=device)
        for taps in axes
        for values, kind in ((taps.first, wp.int32), (taps.weight, wp.vec4))
    ]


def see_vertices(lens: Lens, top: DeviceTop, taps_x: Taps, taps_y: Taps, surface) -> wp.array:
    """Vertices (F, N, M) of the displaced top; `surface` is (F, X, Y) of vec3 [m]."""
    device = surface.device
    shape = (surface.shape[0], len(top.x), len(top.y))
    out = wp.empty(shape, dtype=wp.vec3, device=device)
    taps = tap_arrays((taps_x, taps_y), device)
    wp.launch(
        _kernel(),
        dim=shape,
        inputs=[lens, top.x, top.y, top.height, *taps, surface],
        outputs=[out],
        device=device,
    )
    return out


# From the displacement of the untouched image back to where material points are seen.

# Layers of places beside the gel that are given a displacement before anything is drawn: four
# values around a point of its border reach two of them, three where the image is turned.
LAYERS = 4


def without_gaps(field: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The field (F, R, C, 2) gone on straight from its known places (R, C); 0 far beyond them.

    A place that has two known ones in a row beside it goes on from them, from several such pairs
    in the mean; then its neighbours do, `LAYERS` times.
    """
    field = field.astype(np.float32)
    field[:, ~known] = 0
    for _ in range(LAYERS):
        total = np.zeros_like(field)
        count = np.zeros(known.shape, int)
        for row, column in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            near, far = (_shifted(known, row * k, column * k) for k in (1, 2))
            pair = near & far & ~known
            values = [_shifted(field, row * k, column * k) for k in (1, 2)]
            total[:, pair] += (2 * values[0] - values[1])[:, pair]
            count += pair
        new = count > 0
        field[:, new] = total[:, new] / count[new][:, None]
        known = known | new
    return field


def _shifted(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Each place's neighbour so many rows and columns on; 0 or False beyond the border."""
    axes = (0, 1) if values.ndim == 2 else (1, 2)
    found = np.roll(values, (-rows, -columns), axis=axes)
    for axis, shift in zip(axes, (rows, columns), strict=True):
        edge = [slice(None)] * values.ndim
        edge[axis] = slice(-shift, None) if shift > 0 else slice(0, -shift)
        if shift:
            found[tuple(edge)] = 0
    return found


@functools.cache
def _vertices_kernel():
    @wp.func
    def weights(t: float):
        """Catmull and Rom's four weights between evenly spaced values."""
        return wp.vec4(
            0.5 * t * ((2.0 - t) * t - 1.0),
            0.5 * (t * t * (3.0 * t - 5.0) + 2.0),
            0.5 * t * ((4.0 - 3.0 * t) * t + 1.0),
            0.5 * t * t * (t - 1.0),
        )

    @wp.kernel(enable_backward=False, module="unique")
    def vertices(
        # Settings:
        lens: Lens,
        step: float,
        margin: float,
        # Untouched top:
        x: wp.array[float],
        y: wp.array[float],
        height: wp.array2d[float],
        # In: displacement of the untouched image
        field: wp.array3d[wp.vec2],
        # Out: column, row, nearness
        vertex_out: wp.array3d[wp.vec3],
    ):
        frame, i, j = wp.tid()
        before = seen(lens, wp.vec3(x[i], y[j], height[i, j]))
        rows, columns = field.shape[1], field.shape[2]
        across = wp.clamp((before[0] + margin) / step, 0.0, float(columns - 1))
        down = wp.clamp((before[1] + margin) / step, 0.0, float(rows - 1))
        column = wp.min(int(across), columns - 2)
        row = wp.min(int(down), rows - 2)
        weight_column = weights(across - float(column))
        weight_row = weights(down - float(row))
        moved = wp.vec2()
        for a in range(4):
            r = wp.clamp(row + a - 1, 0, rows - 1)
            along = wp.vec2()
            for b in range(4):
                c = wp.clamp(column + b - 1, 0, columns - 1)
                along += field[frame, r, c] * weight_column[b]
            moved += along * weight_row[a]
        vertex_out[frame, i, j] = wp.vec3(before[0] + moved[0], before[1] + moved[1], before[2])

    return vertices


def vertices_from_lattice(lens: Lens, top: DeviceTop, lattice: Lattice, field) -> wp.array:
    """Vertices (F, N, M) of the top, moved in the image by a field (F, R, C) of vec2 [px].

    The field does not say how near to the camera anything is: vertices are as near as untouched.
    """
    device = field.device
    shape = (field.shape[0], len(top.x), len(top.y))
    out = wp.empty(shape, dtype=wp.vec3, device=device)
    wp.launch(
        _vertices_kernel(),
        dim=shape,
        inputs=[
            lens,
            float(lattice.step_px),
            float(lattice.margin_px),
            top.x,
            top.y,
            top.height,
            field,
        ],
        outputs=[out],
        device=device,
    )
    return out


# The displacement that the camera sees, on a lattice of the untouched image.
#
# What the untouched gel shows at pixel p is seen at p + d(p). d is kept instead of images: whatever
# the pattern, its image follows.


def seen_places(lattice: Lattice, camera: Camera, body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Place and height (n, 3) [m] of the material points that places see, and which places (R, C).

    Places that see no gel are left out.
    """
    pixels = np.stack(np.meshgrid(lattice.columns, lattice.rows), axis=-1)
    places = camera.places(pixels, body)
    with np.errstate(invalid="ignore"):
        on_gel = body.covers(places[..., 0], places[..., 1])
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
