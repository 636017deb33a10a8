"""Picture of a result on one page: maps of the surface from above, a section, and the force."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image, ImageDraw
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import binary_erosion, map_coordinates

from recorder.plot import INK, PANEL, PAPER, SOFT, Curve, font, line_plot
from sim.result import Result
from sim.scene import Body

# Deformed surface from above, by the current position of its material.

Array = NDArray[np.float64]

# Least number of points along each side to which the surface is refined before it is drawn.
FINE = 200
# Iterations that search for the material at a place, and the share of the miss corrected in each:
# they converge unless the surface folds over or is stretched to more than 2.8 times its length.
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
    between = -(-FINE // (len(along) - 1))
    return np.linspace(along[0], along[-1], between * (len(along) - 1) + 1)


def _values_between(x: Array, y: Array, values: ArrayLike, fine_x: Array, fine_y: Array) -> Array:
    """Interpolate values (X, Y, ...) at finer places, by cubics without overshoot.

    A spline would oscillate around the rim of a contact and draw ripples that are not in the data.
    """
    given = np.asarray(values, np.float64)
    along_x = PchipInterpolator(x, given, axis=0)(fine_x)
    refined: Array = PchipInterpolator(y, along_x, axis=1)(fine_y)
    return refined


# Section through body and indenter along x, true to scale.

SOFT_BODY, SKIN = (206, 220, 222), (52, 104, 140)
METAL, PLATE = (152, 158, 168), (92, 98, 108)
# Supersampling factor: Pillow draws edges without anti-aliasing.
SMOOTH = 3
# Free height above the undeformed surface, in thicknesses.
HEADROOM = 0.35
# Height of the plate below the body, in thicknesses.
PLATE_SHARE = 0.08


def section_size(result: Result, surface: Surface, width: int) -> tuple[int, int]:
    """Return width and height [px] of a section that is `width` wide."""
    body = result.scene.body
    tall = body.thickness * (1 + HEADROOM + PLATE_SHARE)
    return width, max(40, round(width * tall / (2 * surface.half_x)))


def draw_section(
    page: Image.Image, at: tuple[int, int], result: Result, frame: int, surface: Surface, width: int
) -> None:
    """Draw the section through the tip with its upper left corner at `at` [px]."""
    width, height = section_size(result, surface, width)
    body, tip = result.scene.body, result.scene.motion.tip[frame]
    size = width * SMOOTH, height * SMOOTH
    pixel = 2 * surface.half_x / size[0]
    x = (np.arange(size[0]) + 0.5) * pixel - surface.half_x
    top = body.thickness * HEADROOM

    def row(z: np.ndarray | float) -> np.ndarray:
        return np.asarray((top - np.asarray(z)) / pixel)

    rows = np.arange(size[1])[:, None]
    base = row(-body.thickness)
    skin, _ = surface.at(x, np.full_like(x, np.clip(tip[1], -surface.half_y, surface.half_y)))
    known = np.isfinite(skin)
    surface_row = np.where(known, row(np.where(known, skin, 0.0)), np.inf)
    below = (rows >= surface_row) & (rows < base)
    edge = np.abs(rows - surface_row) < SMOOTH
    lower = tip[2] + result.scene.indenter.heights(x - tip[0], np.zeros_like(x), reach=0.1)
    solid = np.isfinite(lower)
    metal = solid & (rows <= row(np.where(solid, lower, 0.0)))
    pixels = np.empty((size[1], size[0], 3), np.uint8)
    pixels[:] = PANEL
    pixels[below] = SOFT_BODY
    pixels[metal] = METAL
    pixels[edge] = SKIN
    pixels[np.broadcast_to(rows >= base, below.shape)] = PLATE
    image = Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX)
    page.paste(image, at)
    pen = ImageDraw.Draw(page)
    pen.text((at[0], at[1] - 10), "section through the tip", INK, font(16), anchor="ls")
    note = f"along x at y = {tip[1] * 1e3 + 0.0:.3g} mm, true to scale"
    pen.text((at[0] + width, at[1] - 10), note, SOFT, font(13), anchor="rs")


# Colour scales of the maps, and the numbers next to them.

Scale = tuple[tuple[int, int, int], ...]

# Low is dark blue, high is light sand; evenly spaced, with rising brightness.
HEIGHT: Scale = ((24, 44, 84), (40, 92, 134), (84, 148, 160), (166, 200, 180), (244, 236, 208))
# None is paper, the most is dark red; evenly spaced, with falling brightness.
PRESSURE: Scale = ((250, 250, 248), (253, 220, 150), (244, 150, 80), (208, 62, 60), (104, 16, 56))


def coloured(share: Array, scale: Scale) -> Array:
    """Return the colour (..., 3) for each share, 0 to 1, of a scale."""
    stops = np.array(scale, float)
    at = np.clip(np.nan_to_num(share), 0, 1) * (len(stops) - 1)
    places = np.arange(len(stops))
    return np.stack([np.interp(at, places, stops[:, band]) for band in range(3)], axis=-1)


def round_numbers(low: float, high: float, about: int) -> list[float]:
    """Return about `about` round numbers within the limits."""
    if not high > low:
        return [low]
    step = round_below(1.5 * (high - low) / about)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(index * step, 12) for index in range(first, last + 1)]


def round_below(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above `value`."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))


Box = tuple[int, int, int, int]

# Direction of the light: upper left.
LIGHT = np.array([-0.55, 0.55, 0.63])
# Steepest slope that the shading shows; flatter reliefs are raised by a factor of at most
# `RAISED_MOST`.
RELIEF = 0.7
RAISED_MOST = 12.0
# Colour of the body's outline.
RIM = (176, 182, 192)
BAR_GAP, BAR_WIDTH = 14, 14


@dataclass(frozen=True, slots=True)
class Sampled:
    """Surface sampled at the pixels of one map, y up."""

    height: Array
    """Height (rows, columns) [m]; NaN outside the body."""
    pressure: Array
    """Pressure (rows, columns) [Pa]; NaN outside the body."""
    pixel: float
    """Width of a pixel [m]."""
    pressure_max: float
    """Largest pressure of the result [Pa]."""


def sampled(surface: Surface, size: int) -> Sampled:
    """Sample the surface at pixels, `size` of them along its longer side."""
    pixel = 2 * max(surface.half_x, surface.half_y) / size
    columns, rows = round(2 * surface.half_x / pixel), round(2 * surface.half_y / pixel)
    x = (np.arange(columns) + 0.5 - columns / 2) * pixel
    y = (rows / 2 - np.arange(rows) - 0.5) * pixel
    height, pressure = surface.at(x[None, :], y[:, None])
    return Sampled(height, pressure, pixel, surface.pressure_max)


def draw_heights(page: Image.Image, at: tuple[int, int], surface: Sampled) -> None:
    """Draw the relief with its upper left corner at `at` [px]."""
    low, high = float(np.nanmin(surface.height)), float(np.nanmax(surface.height))
    # An undeformed surface has one height: give its scale some width.
    low, high = (low, high) if high - low > 1e-6 else (low - 5e-7, high + 5e-7)
    colours = coloured((surface.height - low) / (high - low), HEIGHT)
    _paste(page, at, colours * _shade(surface)[..., None], surface)
    _bar(page, at, surface, HEIGHT, (low * 1e3, high * 1e3), "height [mm]")


def draw_pressure(page: Image.Image, at: tuple[int, int], surface: Sampled) -> None:
    """Draw the pressure, faintly shaded, with its upper left corner at `at` [px]."""
    most = max(surface.pressure_max, 1.0)
    colours = coloured(surface.pressure / most, PRESSURE)
    faint = 0.75 + 0.25 * _shade(surface)
    _paste(page, at, colours * np.minimum(faint, 1.04)[..., None], surface)
    _bar(page, at, surface, PRESSURE, (0.0, most / 1e3), "contact pressure [kPa]")


def _shade(surface: Sampled) -> Array:
    """Return the brightness of each pixel: 1 where the surface is level."""
    down, right = (np.nan_to_num(slope) for slope in np.gradient(surface.height, surface.pixel))
    steepest = float(np.percentile(np.hypot(down, right), 98)) or 1e-9
    raised = float(np.clip(RELIEF / steepest, 1.0, RAISED_MOST))
    normal = np.stack([-right * raised, down * raised, np.ones_like(right)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = LIGHT / np.linalg.norm(LIGHT)
    lit: Array = np.clip(0.35 + 0.65 * (normal @ light) / light[2], 0.2, 1.25)
    return lit


def _paste(page: Image.Image, at: tuple[int, int], colours: Array, surface: Sampled) -> None:
    inside = np.isfinite(surface.height)
    pixels = np.where(inside[..., None], np.clip(colours, 0, 255), np.array(PANEL, float))
    pixels[inside & ~binary_erosion(inside)] = RIM
    page.paste(Image.fromarray(np.round(pixels).astype(np.uint8)), at)
    rows, columns = surface.height.shape
    left, bottom = at[0] + 14, at[1] + rows - 16
    length = round_below(0.3 * columns * surface.pixel * 1e3)
    right = left + round(length * 1e-3 / surface.pixel)
    pen = ImageDraw.Draw(page)
    pen.rectangle((left - 7, bottom - 24, right + 7, bottom + 8), PANEL)
    pen.line((left, bottom, right, bottom), INK, 3)
    pen.text(((left + right) / 2, bottom - 5), f"{length:g} mm", INK, font(14), anchor="mb")


def _bar(
    page: Image.Image,
    at: tuple[int, int],
    surface: Sampled,
    scale: Scale,
    limits: tuple[float, float],
    title: str,
) -> None:
    """Draw the title above a map and its colour bar to the right."""
    rows, columns = surface.height.shape
    pen = ImageDraw.Draw(page)
    pen.text((at[0], at[1] - 10), title, INK, font(16), anchor="ls")
    pen.text((at[0] + columns, at[1] - 10), "x right, y up", SOFT, font(13), anchor="rs")
    left = at[0] + columns + BAR_GAP
    shares = np.linspace(1, 0, rows)[:, None].repeat(BAR_WIDTH, axis=1)
    strip = np.round(coloured(shares, scale)).astype(np.uint8)
    page.paste(Image.fromarray(strip), (left, at[1]))
    low, high = limits
    for tick in round_numbers(low, high, 7):
        y = at[1] + (rows - 1) * (high - tick) / (high - low)
        pen.line((left + BAR_WIDTH, y, left + BAR_WIDTH + 4, y), SOFT)
        pen.text((left + BAR_WIDTH + 8, y), f"{tick:g}", SOFT, font(13), anchor="lm")


# One page per result: relief and pressure of the frame with the largest force, section, and force.

WIDTH, MARGIN = 1160, 40
# Longer side of a map [px].
MAP = 450
COLUMN = (WIDTH - 3 * MARGIN) // 2
PLOT_HEIGHT = 250
NORMAL, SHEAR = (196, 78, 62), (62, 118, 196)


def save_picture(result: Result, path: Path) -> None:
    """Write the page as a PNG."""
    draw_page(result).save(path, "PNG")


def shown_frame(result: Result) -> int:
    """Return the frame that the maps show: the one with the largest force."""
    return int(np.argmax(np.linalg.norm(result.force, axis=1)))


def draw_page(result: Result) -> Image.Image:
    """Draw the page: two maps above, section and force below."""
    frame = shown_frame(result)
    surface = surface_of(result, frame)
    seen = sampled(surface, MAP)
    rows = seen.height.shape[0]
    second = 2 * MARGIN + COLUMN
    section = section_size(result, surface, COLUMN)[1]
    lower = 110 + rows + 54
    page = Image.new("RGB", (WIDTH, lower + max(section, PLOT_HEIGHT - 34) + 30), PAPER)
    pen = ImageDraw.Draw(page)
    pen.text((MARGIN, 40), _title(result), INK, font(22), anchor="ls")
    pen.text((MARGIN, 62), _frame_text(result, frame), SOFT, font(14), anchor="ls")
    draw_heights(page, (MARGIN, 110), seen)
    draw_pressure(page, (second, 110), seen)
    draw_section(page, (MARGIN, lower), result, frame, surface, COLUMN)
    page.paste(_plot(result), (second - 24, lower - 34))
    return page


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


def _plot(result: Result) -> Image.Image:
    x, label = abscissa(result)
    force = result.force
    curves = [Curve("normal", -force[:, 2], NORMAL)]
    shear = np.hypot(force[:, 0], force[:, 1])
    if shear.max() > 0.01 * np.abs(force).max():
        across = _direction(result)
        curves.append(Curve("shear", force[:, :2] @ across, SHEAR))
    return line_plot(
        (COLUMN + 24, PLOT_HEIGHT),
        x,
        curves,
        title="force [N]",
        marks=np.zeros(0),
        x_label=label,
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
