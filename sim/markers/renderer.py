# mypy: ignore-errors
# Holds Warp arrays, typed at run time; mypy cannot follow them.
"""From a deformed surface to what the camera sees, whatever the pattern."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from recorder.markers import Lattice, unpack
from sim.errors import SceneError
from sim.markers.camera import Camera
from sim.markers.kernels import (
    DeviceTop,
    coverages,
    displacements,
    find_material,
    lens_of,
    packed_masks,
    see_triangles,
    see_vertices,
    seen_places,
    vertices_from_lattice,
    without_gaps,
)
from sim.markers.textures import STEP, Markers, Textures, textures_of
from sim.markers.top import TAPS, Taps, cubic_taps, top_of
from sim.scene import Body

# What the camera sees of a gel, before any pattern: the material point at each pixel.


class View:
    """F frames as a camera sees them; any pattern can be looked at."""

    def __init__(self, material, samples: int, body: Body) -> None:
        """Hold `material`, x and y [m] at `samples` x `samples` samples a pixel (F, H, W)."""
        self._material, self._samples, self._body = material, samples, body

    def __len__(self) -> int:
        """Number of frames."""
        return self._material.shape[0]

    def material(self) -> NDArray[np.float32]:
        """Untouched place, x and y [m], of what each sample sees (F, H, W, 2).

        NaN where there is no gel. H and W are 480 and 640 times the samples along a pixel's side.
        """
        seen = self._material.numpy()
        if self._body.footprint == "rectangle":
            return seen
        on_gel = self._body.covers(seen[..., 0], seen[..., 1])
        return np.where(on_gel[..., None], seen, np.float32(np.nan))

    def packed(self, textures: Textures) -> NDArray[np.uint8]:
        """Masks of every frame and pattern as packed bits (F, P, 38400)."""
        return packed_masks(self._material, self._samples, textures).numpy()

    def masks(self, textures: Textures) -> NDArray[np.bool_]:
        """The same (F, P, 480, 640): True where a marker covers at least half of a pixel."""
        return unpack(self.packed(textures))

    def coverage(self, textures: Textures) -> NDArray[np.uint8]:
        """Share of each pixel that markers cover, 255 for all of it (F, P, 480, 640)."""
        return coverages(self._material, self._samples, textures).numpy()


Array = NDArray[np.float64]
Surface = NDArray[np.float32]

# Distance of the points that the surface is refined to [m].
SPACING = 0.1e-3
# Samples along a pixel's side. An even number makes markers larger: an edge along a pixel's middle
# lies between samples, and half of them count as half of the pixel wherever it is in between.
SAMPLES = (1, 3, 5, 7, 9)


class Renderer:
    """One gel under one camera; keeps what is computed once.

    A frame takes 5 MB of the device's memory, times the square of `samples`; patterns share it.

    Raises:
        SceneError: A camera that sits in the gel, or an option that is out of range.
    """

    def __init__(
        self,
        body: Body,
        camera: Camera | None = None,
        *,
        spacing: float = SPACING,
        samples: int = 1,
        device: str = "cpu",
    ) -> None:
        """Look at `body` with `camera` (the paper's unless given).

        Args:
            body: The gel.
            camera: Where it is seen from.
            spacing: Distance of the points that the surface is refined to [m].
            samples: Samples along each side of a pixel; 1 is exact to first order in its size.
            device: `cpu`, `cuda:0` and the like.
        """
        self.body, self.camera = body, Camera.paper() if camera is None else camera
        if self.camera.distance <= body.thickness:
            raise SceneError(
                f"camera.distance: {self.camera.distance:.6g} m; allowed: above the gel's "
                f"thickness of {body.thickness:.6g} m (the camera would sit in it)"
            )
        if samples not in SAMPLES:
            allowed = ", ".join(map(str, SAMPLES))
            raise SceneError(f"render.samples: {samples!r}; allowed: {allowed}")
        self.samples, self.device = samples, device
        self._top = top_of(body, spacing)
        self._device_top = DeviceTop.of(self._top, device)
        self._lens = lens_of(self.camera)

    def textures(self, markers: Sequence[Markers], *, step: float = STEP) -> Textures:
        """Patterns made ready for `View.masks`; each must fit on the gel."""
        return textures_of(markers, self.body, step=step, device=self.device)

    def untouched(self) -> View:
        """What is seen before anything touches: one frame, the reference of every pattern."""
        axes = [np.linspace(-size / 2, size / 2, TAPS) for size in self._size]
        return self.see(*axes, np.zeros((1, TAPS, TAPS, 3), np.float32))

    def see(self, x: Array, y: Array, surface: Surface) -> View:
        """What is seen of the gel in F frames.

        Args:
            x: x of the surface's points before anything touched them (X,) [m], rising.
            y: The same for y (Y,).
            surface: Their displacement (F, X, Y, 3) [m].

        Raises:
            SceneError: Displacements that are not finite or of another shape, or points that
                leave more of the gel's border out than their distance from each other.
        """
        taps = _taps(x, y, self._top.x, self._top.y)
        moved = self._checked(x, y, surface)
        return self._view(see_vertices(self._lens, self._device_top, *taps, moved))

    def displacement(
        self,
        x: Array,
        y: Array,
        surface: Surface,
        lattice: Lattice | None = None,
        *,
        dtype: type[np.floating] = np.float16,
    ) -> NDArray[np.floating]:
        """How far what the untouched gel shows at places of the image has moved.

        Arguments and errors as `see`; `dtype` is of the answer, float16 as archives keep it.

        Returns:
            (F, rows, columns, 2) [px], columns to the right and rows down; NaN where the untouched
            gel is not seen.
        """
        lattice = Lattice() if lattice is None else lattice
        places, on_gel = seen_places(lattice, self.camera, self.body)
        taps = _taps(x, y, places[:, 0], places[:, 1])
        moved = self._checked(x, y, surface)
        field = np.full((len(surface), *lattice.shape), np.nan, dtype)
        field[:, on_gel] = displacements(self._lens, places, *taps, moved).numpy()
        return field

    def see_displacement(self, field: NDArray[np.floating], lattice: Lattice | None = None) -> View:
        """What is seen, from what `displacement` gave (F, rows, columns, 2) [px].

        Where the gel folds over, the field cannot tell which part is nearer.

        Raises:
            SceneError: A field of another shape, or not finite somewhere on the gel.
        """
        lattice = Lattice() if lattice is None else lattice
        if field.ndim != 4 or field.shape[1:] != lattice.shape:
            allowed = "(frames, " + ", ".join(map(str, lattice.shape)) + ")"
            raise SceneError(f"displacement: shape {field.shape}; allowed: {allowed}")
        _, on_gel = seen_places(lattice, self.camera, self.body)
        if not np.isfinite(field[:, on_gel]).all():
            raise SceneError(
                "displacement: not finite at places that see the gel; allowed: a field of this "
                "body and camera"
            )
        filled = wp.array(without_gaps(field, on_gel), dtype=wp.vec2, device=self.device)
        return self._view(vertices_from_lattice(self._lens, self._device_top, lattice, filled))

    @property
    def _size(self) -> tuple[float, float]:
        return self.body.size_x, self.body.size_y

    def _view(self, vertex: wp.array) -> View:
        number = see_triangles(vertex, self.samples)
        material = find_material(self._top, vertex, number, self.samples)
        return View(material, self.samples, self.body)

    def _checked(self, x: Array, y: Array, surface: Surface) -> wp.array:
        """The displacement on the device."""
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


def _taps(x: Array, y: Array, to_x: Array, to_y: Array) -> tuple[Taps, Taps]:
    """Taps of places along x and along y among the surface's points."""
    return cubic_taps(x, to_x, name="surface_x"), cubic_taps(y, to_y, name="surface_y")
