"""Picture of a result on one page: maps of the surface from above, a section, and the force."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import map_coordinates

from recorder.charts import BAND, BLUE, chart
from sim.result import Result
from sim.scene import Body

if TYPE_CHECKING:
    from recorder.charts import Axes

# Deformed surface from above, by the current position of its material.

Array = NDArray[np.float64]

# Least number of points along each side to which the surface is refined before it is drawn.
FINE = 200
# Iterations that search for the material at a place, and the fraction of the miss corrected in
# each: they converge unless the surface folds over or is stretched to more than 2.8 times its
# length.
ROUNDS, RELAXATION = 40, 0.7


@dataclass(frozen=True, slots=True)
class Surface:
    """Height and pressure over the current position of the material."""

    half_x: float
    """Half the width of the visible area [m]."""
    half_y: float
    """Half the width along y [m]."""
    pressure_max: float
    """Largest pressure of the result, before any refinement [Pa]."""
    _corner: Array
    """Least x and y of the undeformed points (2,) [m]."""
    _spacing: Array
    """Distance between them along x and y (2,) [m]."""
    _fields: Array
    """Sideways shift (2), height and pressure of each point (4, X, Y)."""
    _body: Body
    """Body of the surface."""

    def at(self, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
        """Return the height above the undeformed apex [m] and pressure [Pa] at x, y (broadcast).

        NaN outside the body.
        """
        shape = np.broadcast_shapes(np.shape(x), np.shape(y))
        place = np.stack([np.broadcast_to(axis, shape).ravel() for axis in (x, y)])
        origin = place.astype(np.float64)
        if self._fields[:2].any():
            for _ in range(ROUNDS):
                shift = np.stack([self._look(axis, origin) for axis in (0, 1)])
                origin += RELAXATION * (place - shift - origin)
        outside = ~self._body.covers(*origin)
        height, pressure = (np.where(outside, np.nan, self._look(one, origin)) for one in (2, 3))
        pressure = np.clip(pressure, 0.0, self.pressure_max)
        return height.reshape(shape), pressure.reshape(shape)

    def _look(self, field: int, origin: Array) -> Array:
        """Return a field (N,) at undeformed places (2, N), extended beyond its edges."""
        index = (origin - self._corner[:, None]) / self._spacing[:, None]
        found: Array = map_coordinates(self._fields[field], index, order=1, mode="nearest")
        return found


def surface_of(result: Result, frame: int) -> Surface:
    """Return the surface of one frame, refined so that a coarse mesh looks smooth.

    The linear `layer` tier computes contact at undeformed positions, so its points are drawn there.
    """
    x, y = result.surface_x, result.surface_y
    body = result.scene.body
    fine_x, fine_y = _refined(x), _refined(y)
    moved = _values_between(x, y, result.surface[frame], fine_x, fine_y)
    traction = np.nan_to_num(result.traction[frame, :, :, 2].astype(np.float64))
    pressure = np.maximum(-traction, 0.0)
    rest = body.heights(fine_x, fine_y)
    shift = moved[..., :2] * (result.tier != "layer")
    drawn = _values_between(x, y, pressure, fine_x, fine_y)
    place = np.stack(np.meshgrid(fine_x, fine_y, indexing="ij"), axis=-1) + shift
    reach = np.abs(place).max(axis=(0, 1))
    half = np.array([body.size_x, body.size_y]) / 2
    return Surface(
        half_x=max(float(half[0]), float(reach[0])),
        half_y=max(float(half[1]), float(reach[1])),
        pressure_max=float(pressure.max()),
        _corner=np.array([x[0], y[0]]),
        _spacing=np.array([fine_x[1] - fine_x[0], fine_y[1] - fine_y[0]]),
        _fields=np.stack([*np.moveaxis(shift, -1, 0), rest + moved[..., 2], drawn]),
        _body=body,
    )


def _refined(along: Array) -> Array:
    """Return evenly spaced `along` with enough points in between for at least `FINE` of them."""
    per_cell = -(-FINE // (len(along) - 1))
    return np.linspace(along[0], along[-1], per_cell * (len(along) - 1) + 1)


def _values_between(x: Array, y: Array, values: ArrayLike, fine_x: Array, fine_y: Array) -> Array:
    """Interpolate values (X, Y, ...) at finer places, by cubics without overshoot.

    A spline would oscillate around the rim of a contact and draw ripples that are not in the data.
    """
    given = np.asarray(values, np.float64)
    along_x = PchipInterpolator(x, given, axis=0)(fine_x)
    refined: Array = PchipInterpolator(y, along_x, axis=1)(fine_y)
    return refined


def sampled(surface: Surface, size: int) -> tuple[Array, Array]:
    """Return height [m] and pressure [Pa] in cells (rows, columns), rows along y.

    The longer side has `size` cells; NaN outside the body.
    """
    cell = 2 * max(surface.half_x, surface.half_y) / size
    columns, rows = round(2 * surface.half_x / cell), round(2 * surface.half_y / cell)
    x, y = (cell * (np.arange(count) + (1 - count) / 2) for count in (columns, rows))
    return surface.at(x[None, :], y[:, None])


# One page per result: height and pressure of the frame with the largest force, section, and force.

# Cells along the longer side of a map, and points along the section.
MAP, SECTION = 450, 900
# Width of the page, longest side of a map, height of the lower row and of all labels [inch].
WIDTH, MAP_SIDE, LOWER, LABELS = 9.0, 3.4, 1.6, 1.3
SOFT_BODY, METAL, PLATE = "#cedcde", "#989ea8", "#5c626c"
# Free height above the undeformed surface, and height of the plate below the body, in thicknesses.
HEADROOM, PLATE_SHARE = 0.35, 0.08


def save_picture(result: Result, path: Path) -> None:
    """Write the page of a result, two maps above, section and force below."""
    frame = shown_frame(result)
    surface = surface_of(result, frame)
    upper = MAP_SIDE * min(1.0, surface.half_y / surface.half_x)
    with chart(path, WIDTH, upper + LOWER + LABELS) as figure:
        figure.set_layout_engine("compressed")
        figure.suptitle(f"{_title(result)}\n{_frame_text(result, frame)}", x=0.01, ha="left")
        (height, pressure), (section, force) = figure.subplots(2, 2, height_ratios=(upper, LOWER))
        _draw_maps(height, pressure, surface)
        _draw_section(section, result, frame, surface)
        _draw_force(force, result)


def shown_frame(result: Result) -> int:
    """Return the frame that the maps show: the one with the largest force."""
    return int(np.argmax(np.linalg.norm(result.force, axis=1)))


def _draw_maps(above: Axes, beside: Axes, surface: Surface) -> None:
    """Draw height and pressure from above; outside the body the ground shows."""
    height, pressure = sampled(surface, MAP)
    low, high = 1e3 * np.nanmin(height), 1e3 * np.nanmax(height)
    # An undeformed surface has one height: give its scale some width [mm].
    low, high = (low, high) if high - low > 1e-3 else (low - 5e-4, high + 5e-4)
    most = max(surface.pressure_max, 1.0) / 1e3
    half_x, half_y = 1e3 * surface.half_x, 1e3 * surface.half_y
    extent = (-half_x, half_x, -half_y, half_y)
    for axes, title, values, limits, colours in (
        (above, "height [mm]", 1e3 * height, (low, high), "Blues_r"),
        (beside, "contact pressure [kPa]", 1e-3 * pressure, (0.0, most), "OrRd"),
    ):
        drawn = axes.imshow(values, cmap=colours, clim=limits, origin="lower", extent=extent)
        axes.set(title=title, xlabel="x [mm]", ylabel="y [mm]", facecolor=BAND)
        axes.grid(visible=False)
        axes.figure.colorbar(drawn, ax=axes)


def _draw_section(axes: Axes, result: Result, frame: int, surface: Surface) -> None:
    """Draw body and indenter along x through the tip, true to scale."""
    body, tip = result.scene.body, result.scene.motion.tip[frame]
    x = np.linspace(-surface.half_x, surface.half_x, SECTION)
    skin, _ = surface.at(x, np.clip(tip[1], -surface.half_y, surface.half_y))
    lower = tip[2] + result.scene.indenter.heights(x - tip[0], np.zeros_like(x), reach=0.1)
    top, bottom = 1e3 * HEADROOM * body.thickness, -1e3 * body.thickness
    axes.fill_between(1e3 * x, bottom, 1e3 * skin, color=SOFT_BODY)
    axes.fill_between(1e3 * x, np.minimum(1e3 * lower, top), top, color=METAL, linewidth=0)
    axes.plot(1e3 * x, 1e3 * skin, color=BLUE)
    axes.axhspan((1 + PLATE_SHARE) * bottom, bottom, color=PLATE)
    axes.set(xlabel="x [mm]", ylabel="z [mm]", aspect="equal", anchor="N")
    axes.set(xlim=(1e3 * x[0], 1e3 * x[-1]), ylim=((1 + PLATE_SHARE) * bottom, top))
    axes.set_title(f"section through the tip, y = {tip[1] * 1e3 + 0.0:.3g} mm, true to scale")
    axes.grid(visible=False)


def _draw_force(axes: Axes, result: Result) -> None:
    x, label = abscissa(result)
    force = result.force
    axes.plot(x, -force[:, 2], label="normal")
    shear = np.hypot(force[:, 0], force[:, 1])
    if shear.max() > 0.01 * np.abs(force).max():
        axes.plot(x, force[:, :2] @ _direction(result), label="shear")
        axes.legend()
    axes.set(title="force on the indenter", xlabel=label, ylabel="force [N]")


def _title(result: Result) -> str:
    scene, body = result.scene, result.scene.body
    size = " x ".join(f"{1e3 * side:g}" for side in (body.size_x, body.size_y, body.thickness))
    effects = " and ".join(scene.effects.key) or "elastic, frictionless"
    return f"{scene.indenter.name} into {size} mm of {body.modulus / 1e6:g} MPa, {effects}"


def _frame_text(result: Result, frame: int) -> str:
    x, y, z = (value * 1e3 + 0.0 for value in result.scene.motion.tip[frame])
    force = result.force[frame] + 0.0
    return (
        f"maps and section: tip at x {x:.3g}, y {y:.3g}, depth {-z + 0.0:.3g} mm;  normal "
        f"{-force[2] + 0.0:.3f} N, shear {np.hypot(force[0], force[1]):.3f} N;  tier {result.tier}"
    )


def abscissa(result: Result) -> tuple[Array, str]:
    """Return the values and label of the force's x axis: time if relevant, else depth or path."""
    motion, effects = result.scene.motion, result.scene.effects
    tip = np.array(motion.tip, float)
    if effects.viscosity is not None or effects.inertia is not None:
        return np.array(motion.time, float), "time [s]"
    if (np.diff(tip[:, 2]) < 0).all():
        return -tip[:, 2] * 1e3 + 0.0, "depth [mm]"
    steps = np.linalg.norm(np.diff(tip, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)]) * 1e3, "path of the tip [mm]"


def _direction(result: Result) -> Array:
    """Return the sideways direction of the tip's motion, or of the force without such a motion."""
    tip = np.array(result.scene.motion.tip, float)[:, :2]
    aside = tip - tip[0]
    far = aside[np.argmax(np.linalg.norm(aside, axis=1))]
    if not far.any():
        far = result.force[shown_frame(result), :2]
    return np.asarray(far / np.linalg.norm(far))
