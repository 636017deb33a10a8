"""Live forces compared with `layer` and `fem`.

Sphere, prism and cylinder are pressed to the sensor's depth, sheared, returned and lifted, with the
sensor's friction, viscosity and speed. `live` receives a pose 60 times a second; `layer` and `fem`
receive the frames that are compared.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Page, Run, table
from benchmarks.twin.rows import SPACING
from sim.device import ready_device
from sim.errors import SimulationDiverged
from sim.fem import FOR_EDGES, Fem
from sim.indenters import Indenter, named
from sim.layer import Layer
from sim.scene import Motion, press
from sim.sensors import HETEROGENEOUS, SimulatedSensor, sensor
from sim.stream.stream import GRID, LivePress
from sim.tiers import simulate

Array = NDArray[np.floating[Any]]

INDENTERS = ("sphere", "prism", "cylinder")
# Poses per second of the live sensor.
RATE = 60.0
# Number of frames of each of the four phases.
STEPS = 4
# Direction of the shear [rad], not along a row of pixels.
ANGLE = 0.3


def measure(run: Run) -> list[dict[str, Any]]:
    """Solve every sensor under every indenter; quick: one, without `fem`."""
    ready_device(run.device)
    pairs = [(name, indenter) for name in HETEROGENEOUS for indenter in INDENTERS]
    if run.quick:
        pairs = pairs[:1]
    rows = []
    for name, indenter in pairs:
        solve = partial(compared, sensor(name), named(indenter), run)
        rows.append(run.once(f"{name}, {indenter}", solve))
        run.progress(len(rows) / len(pairs))
    return rows


def compared(each: SimulatedSensor, indenter: Indenter, run: Run) -> dict[str, Any]:
    """Return the errors of live forces, rms and worst by axis, and the largest forces [N]."""
    motion = way(each)
    scene = each.scene(indenter, motion)
    live = live_forces(each, indenter, motion, GRID)
    row: dict[str, Any] = {"sensor": each.name, "indenter": indenter.name}
    tiers: dict[str, Fem | Layer] = {"layer": Layer()}
    if not run.quick:
        tiers["fem"] = Fem(spacing=SPACING[each.name], grading=FOR_EDGES)
    for name, tier in tiers.items():
        try:
            force = simulate(scene, tier, device=run.device).force
        except SimulationDiverged as diverged:
            row[name] = str(diverged).partition("\n")[0]
            continue
        off = live - force
        row[name] = {
            "rms": np.sqrt((off**2).mean(axis=0)).tolist(),
            "worst": np.abs(off).max(axis=0).tolist(),
            "largest": np.abs(force).max(axis=0).tolist(),
        }
    return row


def section(rows: list[dict[str, Any]], _: Page) -> str:
    """Return the table of errors of live forces."""
    lines = []
    for row in rows:
        for name in ("layer", "fem"):
            errors = row.get(name)
            if isinstance(errors, str):
                lines.append([row["sensor"], row["indenter"], name, errors, "", "", ""])
            elif errors is not None:
                cells = [
                    f"{rms:.3f} ({worst:.2f})"
                    for rms, worst in zip(errors["rms"], errors["worst"], strict=True)
                ]
                largest = ", ".join(f"{each:.2f}" for each in errors["largest"])
                lines.append([row["sensor"], row["indenter"], name, *cells, largest])
    head = ["sensor", "indenter", "beside", "Fx", "Fy", "Fz", "largest Fx, Fy, Fz"]
    return f"""## Live forces
Forces of `sim.stream` ({GRID} pixels, {RATE:g} poses a second) beside those of `simulate` for the
same motion: to the sensor's depth, sheared along 17 degrees, back and up. Root mean square (worst)
of the difference [N]; `layer` and live forces take strain as small, `fem` does not.

{table(head, lines)}
"""


def way(each: SimulatedSensor) -> Motion:
    """Return the motion: down to the sensor's full depth, sideways, back and up."""
    plan = each.trajectory
    depth = each.depth_max if plan is None else plan.depth_max
    shear = 0.0 if plan is None else plan.shear
    return press([depth], shear=shear, angle=ANGLE, steps=STEPS, speed=each.speed)


def live_forces(each: SimulatedSensor, indenter: Indenter, motion: Motion, grid: int) -> Array:
    """Return forces (F, 3) [N] at the motion's waypoints, solved at `RATE` in between."""
    live = LivePress(each, indenter, grid=grid)
    tips, times = np.array(motion.tip), np.array(motion.time)
    forces, before = [], 0.0
    for now in times:
        turns = max(1, round((now - before) * RATE))
        for part in np.arange(1, turns + 1) / turns:
            at = before + (now - before) * part
            tip = np.array([np.interp(at, times, axis) for axis in tips.T])
            live.move(tip, (now - before) / turns)
        forces.append(live.wrench[:3])
        before = now
    return np.array(forces)
