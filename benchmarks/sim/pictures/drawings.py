"""Drawings of the paper's indenters in mm: the tip from below, and sections along x and y."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from recorder.charts import BLUE, INK, RED, chart
from sim.indenters.indenter import Indenter
from sim.indenters.shapes import NAMES, named

# Half the width of the base, the height that is drawn, and the spacing of the samples [mm].
HALF, REACH, STEP = 8.5, 6.0, 0.05
LEVELS = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, REACH)


def draw(indenter: Indenter, path: Path) -> None:
    """Write the drawing of an indenter.

    Args:
        indenter: The indenter, tip down.
        path: PNG to write.
    """
    along = np.arange(-HALF, HALF + STEP / 2, STEP)
    x, y = np.meshgrid(along * 1e-3, along * 1e-3)
    height = indenter.heights(x, y, reach=REACH * 1e-3) * 1e3
    middle = len(along) // 2
    with chart(path, 7.0, 3.4) as figure:
        plan, section = figure.subplots(1, 2, width_ratios=(1, 1.15))
        shown = np.where(np.isfinite(height), np.maximum(height, 0.0), np.nan)
        plan.contourf(along, along, shown, levels=LEVELS, cmap="viridis_r")
        plan.contour(along, along, np.isfinite(height) * 1.0, levels=[0.5], colors=INK)
        plan.set_aspect("equal")
        plan.set_title(f"{indenter.name}, tip from above, through the body")
        plan.set_xlabel("x [mm]")
        plan.set_ylabel("y [mm]")
        for values, name, color, style in (
            (height[middle], "y = 0", BLUE, "-"),
            (height[:, middle], "x = 0", RED, "--"),
        ):
            inside = np.where(np.isfinite(values), values, np.nan)
            section.plot(along, inside, style, color=color, label=f"section at {name}")
        section.set_aspect("equal")
        section.set_ylim(-1.0, REACH)
        section.set_title("height above the tip, pressed downwards")
        section.set_xlabel("x or y [mm]")
        section.set_ylabel("z [mm]")
        section.legend(loc="upper center", bbox_to_anchor=(0.5, -0.28), ncols=2)
        for axes in (plan, section):
            axes.set_xlim(-HALF, HALF)
            axes.set_xticks(range(-8, 9, 2))
            axes.grid(visible=True)
        plan.set_yticks(range(-8, 9, 2))
    # A quarter of the size, with no difference that is visible.
    with Image.open(path) as picture:
        small = picture.convert("RGB").quantize(64)
    small.save(path, optimize=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("--out", type=Path, default=Path("rig/bench/indenters"), help="folder")


def run(options: argparse.Namespace) -> int:
    """Draw all indenters with sharp edges; return the exit code."""
    for name in NAMES:
        path = options.out / f"{name}.png"
        draw(named(name, edge_radius=0.0), path)
        print(path)
    return 0
