# mypy: ignore-errors
# Warp assigns types to kernels itself; mypy cannot follow annotations made at run time.
"""Independent marker images: rays through a fine mesh, and markers from their formula.

A check of `Renderer` that shares neither its interpolation, nor its rasteriser, nor its distance
textures. Slow: about 0.1 s for each ray per pixel.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial import cKDTree

from sim.markers import HEIGHT, WIDTH, Camera, Pattern
from sim.scene import Body

Array = NDArray[np.float64]

# Spacing of the mesh's points [m]: half of the spacing that is checked.
SPACING = 0.05e-3


@wp.kernel(enable_backward=False)
def _cast(
    start: wp.vec3, mesh: wp.uint64, direction: wp.array[wp.vec3], material_out: wp.array[wp.vec3]
):
    k = wp.tid()
    query = wp.mesh_query_ray(mesh, start, direction[k], 1.0e3)
    if query.result:
        material_out[k] = wp.mesh_eval_velocity(mesh, query.face, query.u, query.v)


def smooth(x: Array, y: Array, values: Array, to_x: Array, to_y: Array) -> Array:
    """Resample values (X, Y, ...) with cubics whose slopes come from three neighbouring values."""
    slope = np.gradient(values, x, axis=0, edge_order=2)
    along = CubicHermiteSpline(x, values, slope, axis=0)(to_x)
    slope = np.gradient(along, y, axis=1, edge_order=2)
    return CubicHermiteSpline(y, along, slope, axis=1)(to_y)


def cast_rays(
    body: Body, camera: Camera, x: Array, y: Array, surface: Array, *, samples: int = 1
) -> Array:
    """Return the material point, x and y [m], of each sample (480 n, 640 n, 2) for n `samples`.

    `surface` is one frame (X, Y, 3) [m]; the camera must have no separate mount.
    """
    fine_x, fine_y = (
        np.linspace(-size / 2, size / 2, round(size / SPACING) + 1)
        for size in (body.size_x, body.size_y)
    )
    moved = smooth(x, y, surface.astype(float), fine_x, fine_y)
    material = np.stack(np.meshgrid(fine_x, fine_y, indexing="ij"), axis=-1)
    rest = body.heights_at(material[..., 0], material[..., 1])
    rest = np.concatenate([material, rest[..., None]], axis=-1)
    mesh = wp.Mesh(
        points=wp.array((rest + moved).reshape(-1, 3), dtype=wp.vec3, device="cpu"),
        indices=wp.array(_triangles(len(fine_x), len(fine_y)), dtype=wp.int32, device="cpu"),
        # A quantity that Warp interpolates between corners: here the material point.
        velocities=wp.array(rest.reshape(-1, 3), dtype=wp.vec3, device="cpu"),
    )
    column = (np.arange(WIDTH * samples) + 0.5) / samples - WIDTH / 2
    row = (np.arange(HEIGHT * samples) + 0.5) / samples - HEIGHT / 2
    right, down = np.meshgrid(column, row)
    rays = np.stack([right, -down, np.full_like(right, camera.focal)], axis=-1) / camera.focal
    material_out = wp.full(right.size, wp.vec3(np.nan), dtype=wp.vec3, device="cpu")
    wp.launch(
        _cast,
        dim=right.size,
        inputs=[
            wp.vec3(0.0, 0.0, -camera.distance),
            mesh.id,
            wp.array(rays.reshape(-1, 3), dtype=wp.vec3, device="cpu"),
        ],
        outputs=[material_out],
        device="cpu",
    )
    return material_out.numpy().astype(float).reshape(*right.shape, 3)[..., :2]


def marked(pattern: Pattern, material: Array, samples: int) -> NDArray[np.bool_]:
    """Return the mask (480, 640), True where markers cover at least half of the samples."""
    return 2 * fraction_of(pattern, material, samples) >= 1


def fraction_of(pattern: Pattern, material: Array, samples: int) -> Array:
    """Return the fraction of the samples of each pixel (480, 640) that markers cover.

    A point is compared with the marker with the nearest centre only, so markers must be less than
    0.7 times as wide as their distance.
    """
    points = material.reshape(-1, 2)
    seen = np.isfinite(points[:, 0])
    centres = pattern.centres
    inside = np.zeros(len(points), bool)
    _, nearest = cKDTree(centres).query(points[seen])
    inside[seen] = pattern.marker_distance(points[seen] - centres[nearest]) <= 0
    count = inside.reshape(HEIGHT, samples, WIDTH, samples).sum(axis=(1, 3))
    return np.asarray(count / samples**2)


def _triangles(across: int, along: int) -> NDArray[np.int32]:
    """Return corners (3 n,) of two triangles per cell, split opposite to the rasteriser's."""
    number = np.arange(across * along).reshape(across, along)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    return np.stack([a, b, d, b, c, d], axis=-1).ravel().astype(np.int32)
