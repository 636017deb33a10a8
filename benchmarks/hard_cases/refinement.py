"""Part `refinement`: a sphere's force and skin on finer and finer meshes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Page, Run, table
from sim.fem import Fem
from sim.indenters import sphere
from sim.scene import Body, Scene, press
from sim.tiers import simulate

MM = 1e-3
# Elements [mm].
ELEMENTS_MM = (1.25, 1.0, 0.8, 2 / 3, 0.5, 0.4)
# Sphere's radius and depths [m], and its forces without friction [N], on which 8-node bricks with
# one volume change each (60 x 60 x 12) and 27-node bricks (16 x 16 x 4) agree to 0.1 %.
RADIUS, DEPTHS, FORCES = 4e-3, (0.5e-3, 1.0e-3, 1.5e-3), (0.2652, 0.9197, 1.9560)
# At the deepest: distances of points from the axis and how far they rise, and go outwards [m];
# +-3 um.
HEIGHT_AT, HEIGHT = (4e-3, 5e-3, 6e-3, 8e-3), (0.0001e-3, 0.0439e-3, 0.0424e-3, 0.0097e-3)
OUTWARD_AT, OUTWARD = (3e-3, 4e-3, 6e-3), (0.0986e-3, 0.1322e-3, 0.139e-3)


def measure(run: Run) -> list[dict[str, Any]]:
    """Return forces and their errors by element."""
    elements = ELEMENTS_MM[:2] if run.quick else ELEMENTS_MM
    simulate(_sphere(), Fem(spacing=elements[0] * MM), device=run.device)  # compiles the kernels
    rows = []
    for size in elements:
        rows.append(_row(size, run.device))
        run.progress(len(rows) / len(elements))
    return rows


def _sphere() -> Scene:
    return Scene(sphere(RADIUS), press(DEPTHS), Body())


def _row(size: float, device: str) -> dict[str, Any]:
    """Return forces, their errors in percent, the skin's error in um, and seconds."""
    began = time.perf_counter()
    result = simulate(_sphere(), Fem(spacing=size * MM), device=device)
    seconds = time.perf_counter() - began
    force = -result.force[1:, 2]
    middle = len(result.surface_y) // 2
    line = result.surface[-1][:, middle].astype(float)
    if len(result.surface_y) % 2 == 0:
        line = (line + result.surface[-1][:, middle - 1]) / 2
    height = _at(result.surface_x, line[:, 2], HEIGHT_AT) - HEIGHT
    outward = _at(result.surface_x, line[:, 0], OUTWARD_AT) - OUTWARD
    return {
        "mm": round(size, 4),
        "cells": list(result.record["mesh"]["cells"]),
        "force": [round(float(each), 4) for each in force],
        "percent": [float(each) for each in 100 * (force / np.array(FORCES) - 1)],
        "skin_um": float(1e6 * np.abs(np.concatenate([height, outward])).max()),
        "seconds": round(seconds, 2),
    }


def _at(
    x: NDArray[np.float64], values: NDArray[np.float64], places: Sequence[float]
) -> NDArray[np.float64]:
    """Return the values at `places` [m] by a cubic through the four nearest nodes."""
    read = []
    for place in places:
        first = int(np.clip(np.searchsorted(x, place) - 2, 0, len(x) - 4))
        near = slice(first, first + 4)
        read.append(np.polyval(np.polyfit(x[near] - place, values[near], 3), 0.0))
    return np.array(read)


def section(values: list[dict[str, Any]], _page: Page) -> str:
    """Return the table."""
    rows = [
        [
            f"{row['mm']:.3g} mm",
            "x".join(map(str, row["cells"])),
            *(
                f"{force:.4f} N, {error:+.2f} %"
                for force, error in zip(row["force"], row["percent"], strict=True)
            ),
            f"{row['skin_um']:.1f} um",
            f"{row['seconds']:.2f}",
        ]
        for row in values
    ]
    depths = [f"at {depth / MM:g} mm" for depth in DEPTHS]
    text = (
        "## Finer meshes\n\nA sphere of 4 mm into the gel of 20 x 20 x 4 mm (0.145 MPa, nu 0.45, "
        "no friction), against forces on which two element families agree to 0.1 %, and against "
        "heights and outward shifts of the skin at 3 to 8 mm from the axis (largest difference)."
    )
    return f"{text}\n\n{table(['element', 'mesh', *depths, 'skin', 's'], rows)}"
