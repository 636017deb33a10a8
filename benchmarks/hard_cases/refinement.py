"""Part `refinement`: a sphere's force and skin on finer and finer meshes."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.hard_cases.bodies import MM, ball, down
from benchmarks.report import Page, Run, table
from sim.fem import Fem
from sim.metrics import displacement_at, outcome_of
from sim.tiers import simulate

# Elements [mm].
ELEMENTS_MM = (1.25, 1.0, 0.8, 2 / 3, 0.5, 0.4)
# Depths [mm] of a sphere of 4 mm, and its forces without friction [N], on which 8-node bricks with
# one volume change each (60 x 60 x 12) and 27-node bricks (16 x 16 x 4) agree to 0.1 %.
DEPTHS, FORCES = (0.5, 1.0, 1.5), (0.2652, 0.9197, 1.9560)
SCENE = ball(down(*DEPTHS))
# At the deepest: distances of points from the axis, and how far they go outwards and rise [mm];
# +-3 um.
AT = (3.0, 4.0, 5.0, 6.0, 8.0)
OUTWARD = (0.0986, 0.1322, np.nan, 0.139, np.nan)
HEIGHT = (np.nan, 0.0001, 0.0439, 0.0424, 0.0097)


def measure(run: Run) -> list[dict[str, Any]]:
    """Return forces [N], their errors in percent and the skin's error by element."""
    elements = ELEMENTS_MM[:2] if run.quick else ELEMENTS_MM
    simulate(SCENE, Fem(spacing=elements[0] * MM), device=run.device)  # compiles the kernels
    rows = []
    for size in elements:
        began = time.perf_counter()
        result = simulate(SCENE, Fem(spacing=size * MM), device=run.device)
        seconds = time.perf_counter() - began
        force = -result.force[1:, 2]
        moved = displacement_at(outcome_of(result), -1, np.array(AT) * MM, np.zeros(1))[:, 0] / MM
        apart = [moved[:, 0] - OUTWARD, moved[:, 2] - HEIGHT]
        row = {
            "mm": round(size, 4),
            "cells": list(result.record["mesh"]["cells"]),
            "force": [round(float(each), 4) for each in force],
            "percent": [float(each) for each in 100 * (force / np.array(FORCES) - 1)],
            "skin_um": float(1e3 * np.nanmax(np.abs(apart))),
            "seconds": round(seconds, 2),
        }
        rows.append(row)
        run.progress(len(rows) / len(elements))
    return rows


def section(values: list[dict[str, Any]], _page: Page) -> str:
    """Return the table."""
    rows = []
    for row in values:
        pairs = zip(row["force"], row["percent"], strict=True)
        forces = [f"{force:.4f} N, {error:+.2f} %" for force, error in pairs]
        cells = "x".join(map(str, row["cells"]))
        skin, seconds = f"{row['skin_um']:.1f} um", f"{row['seconds']:.2f}"
        rows.append([f"{row['mm']:.3g} mm", cells, *forces, skin, seconds])
    depths = [f"at {depth:g} mm" for depth in DEPTHS]
    text = (
        "## Finer meshes\n\nA sphere of 4 mm into the gel of 20 x 20 x 4 mm (0.145 MPa, nu 0.45, "
        "no friction), against forces on which two element families agree to 0.1 %, and against "
        "heights and outward shifts of the skin at 3 to 8 mm from the axis (largest difference)."
    )
    return f"{text}\n\n{table(['element', 'mesh', *depths, 'skin', 's'], rows)}"
