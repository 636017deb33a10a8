"""One page a result: relief and pressure of its strongest frame, a section, and the force."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from recorder.plot import INK, PAPER, SOFT, Curve, font, line_plot
from sim.picture.maps import draw_heights, draw_pressure, sampled
from sim.picture.sample import surface_of
from sim.picture.section import draw_section, section_size
from sim.result import Result

Array = NDArray[np.float64]

WIDTH, MARGIN = 1160, 40
MAP = 450
"""Longer side of a map [px]."""
COLUMN = (WIDTH - 3 * MARGIN) // 2
PLOT_HEIGHT = 250
NORMAL, SHEAR = (196, 78, 62), (62, 118, 196)


def save_picture(result: Result, path: Path) -> None:
    """Write the page as a PNG."""
    draw_page(result).save(path, "PNG")


def shown_frame(result: Result) -> int:
    """The frame that the maps show: the one with the largest force."""
    return int(np.argmax(np.linalg.norm(result.force, axis=1)))


def draw_page(result: Result) -> Image.Image:
    """The page: two maps above, section and force below."""
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
    """What the force is drawn over: time where it matters, else depth, else the tip's path."""
    motion, effects = result.scene.motion, result.scene.effects
    tip = np.array(motion.tip, float)
    if effects.viscosity is not None or effects.inertia is not None:
        return np.array(motion.time, float), "time [s]"
    if (np.diff(tip[:, 2]) < 0).all():
        return -tip[:, 2] * 1e3 + 0.0, "depth [mm]"
    steps = np.linalg.norm(np.diff(tip, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)]) * 1e3, "path of the tip [mm]"


def _direction(result: Result) -> Array:
    """The sideways direction that the tip is pushed in; that of the force where it is not."""
    tip = np.array(result.scene.motion.tip, float)[:, :2]
    aside = tip - tip[0]
    far = aside[np.argmax(np.linalg.norm(aside, axis=1))]
    if not far.any():
        far = result.force[shown_frame(result), :2]
    return np.asarray(far / np.linalg.norm(far))
