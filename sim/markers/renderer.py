# mypy: ignore-errors
# Holds Warp arrays, typed at run time; mypy cannot follow them.
"""Render a deformed surface as a camera sees it, with any marker pattern."""

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from recorder.markers import Lattice, unpack
from sim.arrays import Array
from sim.errors import SceneError
from sim.markers import kernels
from sim.markers.camera import Camera
from sim.markers.pattern import Pattern
from sim.markers.textures import Textures
from sim.markers.top import TAPS, CubicTaps, cubic_taps, top_of
from sim.scene import Body

# The view of a gel, independent of patterns: the material point at each pixel.


class View:
    """F frames as a camera sees them, from which any pattern can be rendered."""

    def __init__(self, material, body: Body) -> None:
        """Hold `material`, x and y [m] at each pixel (F, 480, 640)."""
        self._material, self._body = material, body

    def __len__(self) -> int:
        return self._material.shape[0]

    def material(self) -> NDArray[np.float32]:
        """Return undeformed x and y [m] of the material point at each pixel (F, 480, 640, 2).

        NaN where there is no gel.
        """
        material = self._material.numpy()
        if self._body.footprint == "rectangle":
            return material
        on_gel = self._body.covers(material[..., 0], material[..., 1])
        return np.where(on_gel[..., None], material, np.float32(np.nan))

    def packed(self, textures: Textures) -> NDArray[np.uint8]:
        """Return masks of every frame and pattern as packed bits (F, P, 38400)."""
        return kernels.packed_masks(self._material, textures).numpy()

    def masks(self, textures: Textures) -> NDArray[np.bool_]:
        """Return masks (F, P, 480, 640): True if a marker covers at least half of a pixel."""
        return unpack(self.packed(textures))

    def coverage(self, textures: Textures) -> NDArray[np.uint8]:
        """Return each pixel's coverage by markers, 255 if complete (F, P, 480, 640)."""
        return kernels.coverages(self._material, textures).numpy()


Surface = NDArray[np.float32]

# Spacing of the points to which the surface is refined [m].
SPACING = 0.1e-3


class Renderer:
    """Renderer of one gel under one camera; keeps constant data between calls.

    A frame takes 5 MB of the device's memory; patterns share it.

    Raises:
        SceneError: The camera is inside the gel, or an option is out of range.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera | None = None,
        *,
        spacing: float = SPACING,
        device: str = "cpu",
    ) -> None:
        """Prepare rendering of a gel with a camera, by default the paper's.

        `spacing` [m] is that of the points to which the surface is refined.
        """
        self.body, self.camera = body, Camera.paper() if camera is None else camera
        if self.camera.distance <= body.thickness:
            raise SceneError(
                f"camera.distance: {self.camera.distance:.6g} m; allowed: above the gel's "
                f"thickness of {body.thickness:.6g} m (the camera would sit in it)"
            )
        self.device = device
        self._top = top_of(body, spacing)
        self._device_top = kernels.top_on(device, self._top)
        self._lens = kernels.lens_of(self.camera)

    def textures(self, patterns: Sequence[Pattern]) -> Textures:
        """Return textures of patterns for `View.masks`; each must fit on the gel."""
        return Textures(patterns, self.body, device=self.device)

    def undeformed(self) -> View:
        """Return the view of the undeformed gel: one frame, the reference of every pattern."""
        axes = [np.linspace(-size / 2, size / 2, TAPS) for size in self._size]
        return self.see(*axes, np.zeros((1, TAPS, TAPS, 3), np.float32))

    def see(self, x: Array, y: Array, surface: Surface) -> View:
        """Return the view of the gel in F frames, its surface displaced by (F, X, Y, 3) [m].

        Undeformed points are at x (X,) and y (Y,) [m], ascending.

        Raises:
            SceneError: Displacements are not finite or have another shape, or the points end
                further from the gel's border than their spacing.
        """
        taps = _taps(x, y, self._top.x, self._top.y)
        moved = self._checked(x, y, surface)
        vertex = kernels.see_vertices(self._lens, self._device_top, *taps, moved)
        number = kernels.see_triangles(vertex)
        material = kernels.find_material(self._top, vertex, number)
        return View(material, self.body)

    def displacement(self, x: Array, y: Array, surface: Surface) -> NDArray[np.float16]:
        """Return the displacement in the image of material points on the archives' lattice.

        Arguments and errors are those of `see`.

        Returns:
            Displacement (F, rows, columns, 2) [px], columns to the right and rows down; NaN where
            the image without contact shows no gel.
        """
        lattice = Lattice()
        points, on_gel = kernels.lattice_points(lattice, self.camera, self.body)
        taps = _taps(x, y, points[:, 0], points[:, 1])
        moved = self._checked(x, y, surface)
        field = np.full((len(surface), *lattice.shape), np.nan, np.float16)
        field[:, on_gel] = kernels.displacements(self._lens, points, *taps, moved).numpy()
        return field

    @property
    def _size(self) -> tuple[float, float]:
        return self.body.size_x, self.body.size_y

    def _checked(self, x: Array, y: Array, surface: Surface) -> wp.array:
        if surface.ndim != 4 or surface.shape[1:] != (len(x), len(y), 3) or not len(surface):
            allowed = f"(frames, {len(x)}, {len(y)}, 3)"
            raise SceneError(f"surface: shape {surface.shape}; allowed: {allowed}")
        if not np.isfinite(surface).all():
            raise SceneError("surface: not finite; allowed: finite displacements [m]")
        reach = float(np.abs(surface).max())
        if reach > max(self._size):
            raise SceneError(
                f"surface: displaced by {reach:.4g} m; allowed: up to the gel's width of "
                f"{max(self._size):.4g} m (is it in metres?)"
            )
        lowest = float(surface[..., 2].min())
        if lowest < -self.body.thickness:
            raise SceneError(
                f"surface: {-lowest:.4g} m down; allowed: up to the gel's thickness of "
                f"{self.body.thickness:.4g} m"
            )
        return wp.array(
            np.ascontiguousarray(surface, np.float32), dtype=wp.vec3, device=self.device
        )


def _taps(x: Array, y: Array, to_x: Array, to_y: Array) -> tuple[CubicTaps, CubicTaps]:
    """Return the taps of places along x and along y among the surface's points."""
    return cubic_taps(x, to_x, name="surface_x"), cubic_taps(y, to_y, name="surface_y")
