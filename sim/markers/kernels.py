# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Warp kernels of rendering: material points at pixels, marker masks, displacement fields."""

import functools
import math

import numpy as np
import warp as wp

from recorder.markers import Lattice
from sim.errors import SceneError
from sim.markers.camera import HEIGHT, MIDDLE, WIDTH, Camera
from sim.markers.textures import Textures
from sim.markers.top import TAPS, CubicTaps, Top
from sim.scene import Body


@wp.struct
class Lens:
    """A `sim.markers.Camera`: lengths in m and px, rotation as cosine and sine, tilt as matrix."""

    focal: float
    distance: float
    cosine: float
    sine: float
    column: float
    row: float
    turn: wp.mat33
    middle: wp.vec2


def lens_of(camera: Camera) -> Lens:
    """Return the struct of a camera."""
    lens = Lens()
    lens.focal, lens.distance = camera.focal, camera.distance
    lens.cosine, lens.sine = math.cos(camera.rotation), math.sin(camera.rotation)
    lens.column = MIDDLE[0] + camera.shift[0]
    lens.row = MIDDLE[1] + camera.shift[1]
    lens.turn = wp.mat33(camera.turn)
    lens.middle = wp.vec2(*camera.middle)
    return lens


@wp.func
def projected(lens: Lens, place: wp.vec3):
    """Return column and row of a place [m] in the image, and its nearness: distance over depth.

    The nearness is 1 where the gel's axis meets the undeformed top, larger nearer to the camera,
    and, unlike the depth, linear over the image of a plane.
    """
    turned = lens.turn * wp.vec3(place[0], place[1], lens.distance + place[2])
    nearness = lens.distance / turned[2]
    scale = lens.focal / lens.distance * nearness
    x = scale * turned[0] - lens.focal * lens.middle[0]
    y = scale * turned[1] - lens.focal * lens.middle[1]
    return wp.vec3(
        lens.column + lens.cosine * x - lens.sine * y,
        lens.row - lens.sine * x - lens.cosine * y,
        nearness,
    )


# From vertices to the material map: the point of the undeformed gel at each pixel.
#
# Every cell of the grid of vertices is two triangles. The first pass finds the triangle at each
# pixel, the one nearest to the camera where the gel folds over. The second computes the material
# point from the position within that triangle. The first pass keeps the largest of a number per
# pixel, with nearness in its upper bits, so that the order of triangles does not matter.

# Steps per unit of nearness in a pixel's number, finer than float32; 1 is the undeformed top.
NEARNESS_UNIT = 2.0**28
# Upper limit of nearness, so that the number stays positive.
NEARNESS_MOST = 7.9
NEARNESS_BITS = wp.int64(32)
TRIANGLE_MASK = wp.int64(2**32 - 1)
CELL_BITS = 15
# A pixel's number holds nearness, cell along x, cell along y, and which of the cell's triangles.
CELL_MASK = 2**CELL_BITS - 1
# Number of a pixel without gel.
NOTHING = -1
# Fraction of a triangle's height by which a pixel's centre may lie beyond its edge: ten times the
# error of float32, so that no pixel is lost between two triangles.
OVERLAP = 1e-4
# Twice the area below which a triangle is too thin to be visible [px^2].
AREA_LEAST = 1e-9
# Pixels per thread on a CPU; on a GPU a thread takes one.
RUN = 32


def _filled(kernel, shape: tuple[int, ...], dtype, inputs, device) -> wp.array:
    """Return the output of a kernel with a thread for each of its elements."""
    out = wp.empty(shape, dtype=dtype, device=device)
    wp.launch(kernel, shape, inputs, [out], device=device)
    return out


@wp.func
def fractions(a: wp.vec3, b: wp.vec3, c: wp.vec3, column: float, row: float):
    """Return barycentric coordinates of a pixel's centre; -inf or NaN if there is no area."""
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
    """Update the number of every pixel that a triangle covers."""
    last_column = float(number.shape[2] - 1)
    last_row = float(number.shape[1] - 1)
    left = wp.ceil(wp.max(wp.min(wp.min(a[0], b[0]), c[0]) - OVERLAP, 0.0))
    right = wp.floor(wp.min(wp.max(wp.max(a[0], b[0]), c[0]) + OVERLAP, last_column))
    upper = wp.ceil(wp.max(wp.min(wp.min(a[1], b[1]), c[1]) - OVERLAP, 0.0))
    lower = wp.floor(wp.min(wp.max(wp.max(a[1], b[1]), c[1]) + OVERLAP, last_row))
    for row in range(int(upper), int(lower) + 1):
        for column in range(int(left), int(right) + 1):
            fraction = fractions(a, b, c, float(column), float(row))
            if wp.min(wp.min(fraction[0], fraction[1]), fraction[2]) >= -OVERLAP:
                nearness = fraction[0] * a[2] + fraction[1] * b[2] + fraction[2] * c[2]
                level = wp.int64(wp.min(nearness, NEARNESS_MOST) * NEARNESS_UNIT)
                offer = (level << NEARNESS_BITS) | wp.int64(triangle)
                wp.atomic_max(number, frame, row, column, offer)


@wp.kernel(enable_backward=False, module="unique")
def _cover(
    # In: column, row, nearness
    vertex: wp.array3d[wp.vec3],
    # Out: number of each pixel
    number_out: wp.array3d[wp.int64],
):
    frame, i, j = wp.tid()
    a = vertex[frame, i, j]
    b = vertex[frame, i + 1, j]
    c = vertex[frame, i + 1, j + 1]
    d = vertex[frame, i, j + 1]
    first = ((i << CELL_BITS) | j) << 1
    cover_triangle(number_out, frame, first, a, b, c)
    cover_triangle(number_out, frame, first + 1, a, c, d)


def see_triangles(vertex) -> wp.array:
    """Return the number of each pixel (F, H, W) int64."""
    frames, x, y = vertex.shape
    if max(x, y) > CELL_MASK:
        raise SceneError(
            f"render.spacing: {x} x {y} points; allowed: up to {CELL_MASK} along each side"
        )
    shape = (frames, HEIGHT, WIDTH)
    number = wp.full(shape, NOTHING, dtype=wp.int64, device=vertex.device)
    wp.launch(_cover, (frames, x - 1, y - 1), [vertex], [number], device=vertex.device)
    return number


@functools.cache
def _material_kernel(run: int):
    @wp.kernel(enable_backward=False, module="unique")
    def find_material(
        # Settings:
        corner: wp.vec2,
        step: wp.vec2,
        # In:
        vertex: wp.array3d[wp.vec3],
        number: wp.array3d[wp.int64],
        # Out: x and y of the material point; NaN without gel
        material_out: wp.array3d[wp.vec2],
    ):
        frame, row, part = wp.tid()
        for column in range(part * run, (part + 1) * run):
            code = number[frame, row, column]
            material = wp.vec2(wp.NAN, wp.NAN)
            if code >= wp.int64(0):
                triangle = int(code & TRIANGLE_MASK)
                i = triangle >> (CELL_BITS + 1)
                j = (triangle >> 1) & CELL_MASK
                second = triangle & 1
                a = vertex[frame, i, j]
                b = vertex[frame, i + 1, j + second]
                c = vertex[frame, i + 1 - second, j + 1]
                fraction = fractions(a, b, c, float(column), float(row))
                # A quantity that is linear in space is linear in the image once divided by depth.
                share_b = fraction[1] * b[2]
                share_c = fraction[2] * c[2]
                scale = 1.0 / (fraction[0] * a[2] + share_b + share_c)
                both = (share_b + share_c) * scale
                along_x = wp.where(second == 0, both, share_b * scale)
                along_y = wp.where(second == 0, share_c * scale, both)
                material = wp.vec2(
                    corner[0] + step[0] * (float(i) + along_x),
                    corner[1] + step[1] * (float(j) + along_y),
                )
            material_out[frame, row, column] = material

    return find_material


def find_material(top: Top, vertex, number) -> wp.array:
    """Return x and y [m] of the material point at each pixel (F, H, W) vec2; NaN without gel."""
    material = wp.empty(number.shape, dtype=wp.vec2, device=number.device)
    run = RUN if number.device.is_cpu else 1
    frames, rows, columns = number.shape
    inputs = [wp.vec2(*top.corner), wp.vec2(*top.step), vertex, number]
    by_run, kernel = (frames, rows, columns // run), _material_kernel(run)
    wp.launch(kernel, by_run, inputs, [material], device=number.device)
    return material


# From the material map to images: masks, or the coverage of each pixel by markers.
#
# A straight edge covers half of a pixel exactly when the pixel's centre lies on it. A pixel is
# therefore marker (at least half covered) if the signed distance at its centre is not above 0. To
# first order in the size of a pixel, this equals anti-aliasing and thresholding.

# Pixels per byte of a packed mask.
BITS = 8
# Change of the distance between pixels below which there is no edge [m].
FLAT = 1e-12


@wp.struct
class Distances:
    """`sim.markers.Textures`: distances to markers [m], the first value's place, values per m."""

    values: wp.array3d[float]
    corner: wp.vec2
    density: float


def distances_of(textures: Textures) -> Distances:
    """Return the struct of textures."""
    distances = Distances()
    distances.values, distances.density = textures.values, 1.0 / textures.step
    distances.corner = wp.vec2(*textures.corner)
    return distances


@wp.func
def distance_at(textures: Distances, pattern: int, place: wp.vec2):
    """Return the signed distance to a marker's edge [m] at a material point; inf at NaN."""
    if wp.isnan(place[0]):
        return wp.inf
    values = textures.values
    last_row = values.shape[1] - 1
    last_column = values.shape[2] - 1
    x = wp.clamp((place[0] - textures.corner[0]) * textures.density, 0.0, float(last_column))
    y = wp.clamp((place[1] - textures.corner[1]) * textures.density, 0.0, float(last_row))
    column = wp.min(int(x), last_column - 1)
    row = wp.min(int(y), last_row - 1)
    right = x - float(column)
    up = y - float(row)
    low = wp.lerp(values[pattern, row, column], values[pattern, row, column + 1], right)
    high = wp.lerp(values[pattern, row + 1, column], values[pattern, row + 1, column + 1], right)
    return wp.lerp(low, high, up)


@wp.kernel(enable_backward=False, module="unique")
def _pack(
    # In:
    textures: Distances,
    material: wp.array3d[wp.vec2],
    # Out: eight pixels per byte, the first in the highest bit
    packed_out: wp.array3d[wp.uint8],
):
    frame, pattern, byte = wp.tid()
    row = byte * BITS // WIDTH
    first = byte * BITS % WIDTH
    bits = wp.int32(0)
    middle = material[frame, row, first + BITS // 2]
    far = distance_at(textures, pattern, middle)
    for k in range(BITS):
        place = material[frame, row, first + k]
        here = far
        # The bilinear distance changes by at most sqrt 2 times the way.
        if not 2.0 * wp.length_sq(place - middle) < far * far:
            here = distance_at(textures, pattern, place)
        bits = 2 * bits + wp.where(here <= 0.0, 1, 0)
    packed_out[frame, pattern, byte] = wp.uint8(bits)


def packed_masks(material, textures: Textures) -> wp.array:
    """Return packed masks (F, P, H W / 8) uint8 of every frame and pattern."""
    shape = (material.shape[0], len(textures), HEIGHT * WIDTH // BITS)
    return _filled(_pack, shape, wp.uint8, [distances_of(textures), material], material.device)


@wp.func
def distance_beside(
    material: wp.array3d[wp.vec2],
    frame: int,
    row: int,
    column: int,
    textures: Distances,
    pattern: int,
    instead: float,
):
    """Return the distance at a pixel, or `instead` outside the image or the gel."""
    if row < 0 or row >= material.shape[1] or column < 0 or column >= material.shape[2]:
        return instead
    place = material[frame, row, column]
    if wp.isnan(place[0]):
        return instead
    return distance_at(textures, pattern, place)


@wp.kernel(enable_backward=False, module="unique")
def _shade(
    # In:
    textures: Distances,
    material: wp.array3d[wp.vec2],
    # Out: 255 for a fully covered pixel
    coverage_out: wp.array4d[wp.uint8],
):
    frame, pattern, row, column = wp.tid()
    fraction = wp.float32(0.0)
    here = distance_at(textures, pattern, material[frame, row, column])
    if wp.isfinite(here):
        left = distance_beside(material, frame, row, column - 1, textures, pattern, here)
        right = distance_beside(material, frame, row, column + 1, textures, pattern, here)
        above = distance_beside(material, frame, row - 1, column, textures, pattern, here)
        below = distance_beside(material, frame, row + 1, column, textures, pattern, here)
        change = wp.length(wp.vec2(right - left, below - above)) * 0.5
        fraction = wp.where(here <= 0.0, 1.0, 0.0)
        if change > FLAT:
            fraction = wp.clamp(0.5 - here / change, 0.0, 1.0)
    coverage_out[frame, pattern, row, column] = wp.uint8(fraction * 255.0 + 0.5)


def coverages(material, textures: Textures) -> wp.array:
    """Return each pixel's coverage by markers (F, P, H, W) uint8, 255 if complete."""
    shape = (material.shape[0], len(textures), HEIGHT, WIDTH)
    return _filled(_shade, shape, wp.uint8, [distances_of(textures), material], material.device)


# Projection of the top's material points: (frame, x, y) -> column, row, nearness.


def top_on(device, top: Top) -> list[wp.array]:
    """Return x, y and height of a `Top` on a device."""
    values = (top.x, top.y, top.height)
    return [wp.array(value.astype(np.float32), device=device) for value in values]


@wp.struct
class PlaneTaps:
    """`sim.markers.top.CubicTaps` of places along x and along y."""

    first_x: wp.array[int]
    weight_x: wp.array[wp.vec4]
    first_y: wp.array[int]
    weight_y: wp.array[wp.vec4]


def plane_taps(along_x: CubicTaps, along_y: CubicTaps, device) -> PlaneTaps:
    """Return the taps on the device."""
    taps = PlaneTaps()
    for axis, values in (("x", along_x), ("y", along_y)):
        setattr(taps, f"first_{axis}", wp.array(values.first, dtype=wp.int32, device=device))
        setattr(taps, f"weight_{axis}", wp.array(values.weight, dtype=wp.vec4, device=device))
    return taps


@wp.func
def moved_by(surface: wp.array3d[wp.vec3], frame: int, taps: PlaneTaps, i: int, j: int):
    """Return the displacement at the i-th and j-th place from the four by four values around it."""
    total = wp.vec3()
    for a in range(wp.static(TAPS)):
        along = wp.vec3()
        for b in range(wp.static(TAPS)):
            along += surface[frame, taps.first_x[i] + a, taps.first_y[j] + b] * taps.weight_y[j][b]
        total += along * taps.weight_x[i][a]
    return total


@wp.kernel(enable_backward=False, module="unique")
def _project(
    # Settings:
    lens: Lens,
    # Undeformed top:
    x: wp.array[float],
    y: wp.array[float],
    height: wp.array2d[float],
    taps: PlaneTaps,
    # In: displacement
    surface: wp.array3d[wp.vec3],
    # Out: column, row, nearness
    vertex_out: wp.array3d[wp.vec3],
):
    frame, i, j = wp.tid()
    moved = moved_by(surface, frame, taps, i, j)
    vertex_out[frame, i, j] = projected(lens, wp.vec3(x[i], y[j], height[i, j]) + moved)


def see_vertices(
    lens: Lens, top: list[wp.array], taps_x: CubicTaps, taps_y: CubicTaps, surface
) -> wp.array:
    """Return vertices (F, N, M) of the displaced `top_on`; `surface` is (F, X, Y) of vec3 [m]."""
    device = surface.device
    inputs = [lens, *top, plane_taps(taps_x, taps_y, device), surface]
    return _filled(_project, (surface.shape[0], *top[-1].shape), wp.vec3, inputs, device)


# Displacement field in the image, on a lattice of the image without contact.
#
# The material point at pixel p of the image without contact moves to p + d(p).


def lattice_points(lattice: Lattice, camera: Camera, body: Body) -> tuple[np.ndarray, np.ndarray]:
    """Return x, y and height (n, 3) [m] of the material points on a lattice, and a mask (R, C).

    The mask is True for lattice pixels on the gel; others have no point.
    """
    pixels = np.stack(np.meshgrid(lattice.columns, lattice.rows), axis=-1)
    points = camera.places(pixels, body)
    with np.errstate(invalid="ignore"):
        on_gel = body.covers(points[..., 0], points[..., 1])
    x, y = points[on_gel].T
    return np.stack([x, y, body.heights_at(x, y)], axis=1), on_gel


@wp.kernel(enable_backward=False, module="unique")
def _displace(
    # Settings:
    lens: Lens,
    # Places:
    place: wp.array[wp.vec3],
    taps: PlaneTaps,
    # In:
    surface: wp.array3d[wp.vec3],
    # Out: displacement of each place in columns and rows
    displacement_out: wp.array2d[wp.vec2],
):
    frame, k = wp.tid()
    moved = moved_by(surface, frame, taps, k, k)
    before = projected(lens, place[k])
    after = projected(lens, place[k] + moved)
    displacement_out[frame, k] = wp.vec2(after[0] - before[0], after[1] - before[1])


def displacements(
    lens: Lens, places: np.ndarray, taps_x: CubicTaps, taps_y: CubicTaps, surface
) -> wp.array:
    """Return image displacements (F, n) vec2 [px] of material points, with one tap per point."""
    device = surface.device
    on_device = wp.array(places.astype(np.float32), dtype=wp.vec3, device=device)
    inputs = [lens, on_device, plane_taps(taps_x, taps_y, device), surface]
    return _filled(_displace, (surface.shape[0], len(places)), wp.vec2, inputs, device)
