"""Picture of a result on one page: maps of the surface from above, a section, and the force."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator

from recorder.charts import BAND, BLUE, FORCES, chart
from sim.arrays import Array
from sim.result import Result

if TYPE_CHECKING:
    from recorder.charts import Axes

# Least number of points along each side to which the surface is refined before it is drawn.
FINE = 200


@dataclass(frozen=True, slots=True)
class FrameSurface:
    """Points of a surface where they are in one frame, on a grid of its material (n, m)."""

    x: Array
    """Position [m]."""
    y: Array
    height: Array
    """Height above the undeformed apex [m]; NaN outside the body."""
    pressure: Array
    """Contact pressure [Pa]; NaN outside the body."""


def surface_of(result: Result, frame: int, y: Array | None = None) -> FrameSurface:
    """Return the surface of one frame, refined so that a coarse mesh looks smooth.

    The linear `layer` tier computes contact at undeformed positions, so its points are drawn there:
    at undeformed `y` (m,) [m], or all of the body.
    """
    body, along = result.scene.body, (result.surface_x, result.surface_y)
    fine = _refined(along[0]), _refined(along[1]) if y is None else y
    moved = _values_between(*along, result.surface[frame], *fine)
    traction = np.nan_to_num(result.traction[frame, :, :, 2].astype(np.float64))
    pressure = _values_between(*along, np.maximum(-traction, 0.0), *fine)
    moved[..., :2] *= result.tier != "layer"
    outside = ~body.covers(fine[0][:, None], fine[1])
    return FrameSurface(
        fine[0][:, None] + moved[..., 0],
        fine[1] + moved[..., 1],
        np.where(outside, np.nan, body.heights(*fine) + moved[..., 2]),
        np.where(outside, np.nan, pressure),
    )


def _refined(along: Array) -> Array:
    """Return evenly spaced `along` with enough points in between for at least `FINE` of them."""
    per_cell = -(-FINE // (len(along) - 1))
    return np.linspace(along[0], along[-1], per_cell * (len(along) - 1) + 1)


def _values_between(x: Array, y: Array, values: ArrayLike, fine_x: Array, fine_y: Array) -> Array:
    """Interpolate values (X, Y, ...) by cubics without overshoot, which would draw ripples."""
    coarse = np.asarray(values, np.float64)
    along_x = PchipInterpolator(x, coarse, axis=0)(fine_x)
    return np.asarray(PchipInterpolator(y, along_x, axis=1)(fine_y))


# One page per result: height and pressure of the frame with the largest force, section, and force.

# Width of the page, longest side of a map, height of the lower row and of all labels [inch].
WIDTH, MAP_SIDE, LOWER, LABELS = 9.0, 3.4, 1.6, 1.3
SOFT_BODY, METAL, PLATE = "#cedcde", "#989ea8", "#5c626c"
# Free height above the undeformed surface, and height of the plate below the body, in thicknesses.
HEADROOM, PLATE_SHARE = 0.35, 0.08


def save_picture(result: Result, path: Path) -> None:
    """Write the page of a result, two maps above, section and force below."""
    frame = shown_frame(result)
    surface = surface_of(result, frame)
    half_x, half_y = (float(np.abs(axis).max()) for axis in (surface.x, surface.y))
    upper = MAP_SIDE * min(1.0, half_y / half_x)
    with chart(path, WIDTH, upper + LOWER + LABELS) as figure:
        figure.set_layout_engine("compressed")
        figure.suptitle(f"{_title(result)}\n{_frame_text(result, frame)}", x=0.01, ha="left")
        (height, pressure), (section, force) = figure.subplots(2, 2, height_ratios=(upper, LOWER))
        _draw_maps(height, pressure, surface)
        _draw_section(section, result, frame)
        _draw_force(force, result)


def shown_frame(result: Result) -> int:
    """Return the frame that the maps show: the one with the largest force."""
    return int(np.argmax(np.linalg.norm(result.force, axis=1)))


def _draw_maps(above: Axes, beside: Axes, surface: FrameSurface) -> None:
    """Draw height and pressure from above; outside the body the ground shows."""
    low, high = 1e3 * np.nanmin(surface.height), 1e3 * np.nanmax(surface.height)
    # An undeformed surface has one height: give its scale some width [mm].
    low, high = (low, high) if high - low > 1e-3 else (low - 5e-4, high + 5e-4)
    most = max(np.nanmax(surface.pressure), 1.0) / 1e3
    for axes, title, values, limits, colours in (
        (above, "height [mm]", 1e3 * surface.height, (low, high), "Blues_r"),
        (beside, "contact pressure [kPa]", 1e-3 * surface.pressure, (0.0, most), "OrRd"),
    ):
        faces = (values[1:, 1:] + values[:-1, :-1]) / 2
        drawn = axes.pcolormesh(1e3 * surface.x, 1e3 * surface.y, faces, cmap=colours, clim=limits)
        axes.set(title=title, xlabel="x [mm]", ylabel="y [mm]", facecolor=BAND, aspect="equal")
        axes.grid(visible=False)
        axes.figure.colorbar(drawn, ax=axes)


def _draw_section(axes: Axes, result: Result, frame: int) -> None:
    """Draw body and indenter along x through the tip, true to scale."""
    body, tip = result.scene.body, result.scene.motion.tip[frame]
    skin = surface_of(result, frame, np.clip([tip[1]], -body.size_y / 2, body.size_y / 2))
    x, z = skin.x[:, 0], skin.height[:, 0]
    lower = tip[2] + result.scene.indenter.heights(x - tip[0], np.zeros_like(x), reach=0.1)
    top, bottom = 1e3 * HEADROOM * body.thickness, -1e3 * body.thickness
    axes.fill_between(1e3 * x, bottom, 1e3 * z, color=SOFT_BODY)
    axes.fill_between(1e3 * x, np.minimum(1e3 * lower, top), top, color=METAL, linewidth=0)
    axes.plot(1e3 * x, 1e3 * z, color=BLUE)
    axes.axhspan((1 + PLATE_SHARE) * bottom, bottom, color=PLATE)
    axes.set(xlabel="x [mm]", ylabel="z [mm]", aspect="equal", anchor="N")
    axes.set(xlim=(1e3 * x[0], 1e3 * x[-1]), ylim=((1 + PLATE_SHARE) * bottom, top))
    axes.set_title(f"section through the tip, y = {tip[1] * 1e3 + 0.0:.3g} mm, true to scale")
    axes.grid(visible=False)


def _draw_force(axes: Axes, result: Result) -> None:
    x, label = abscissa(result)
    force = result.force
    axes.plot(x, -force[:, 2], "o-", color=FORCES[2], label="normal")
    shear = np.hypot(force[:, 0], force[:, 1])
    if shear.max() > 0.01 * np.abs(force).max():
        axes.plot(x, force[:, :2] @ _direction(result), "o-", color=FORCES[0], label="shear")
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
