"""Live forces compared with `layer` and `fem`.

Sphere, prism and cylinder are pressed to the sensor's depth, sheared, returned and lifted, with the
sensor's friction, viscosity and speed. `live` receives a pose 60 times a second; `layer` and `fem`
receive the frames that are compared.
"""

from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Page, Run, table
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
# Element height of `fem` [m]; at the indenter elements are half as wide.
SPACING = {"uskin": 0.667e-3, "gelsight": 0.667e-3, "tacpalm": 1.2e-3}
# Poses per second of the live sensor.
RATE = 60.0
# Number of frames of each of the four phases.
STEPS = 4
# Direction of the shear [rad], not along a row of pixels.
ANGLE = 0.3


def measure(run: Run) -> list[dict[str, Any]]:
    """Solve every sensor under every indenter by `fem`; quick: one, by `layer`."""
    ready_device(run.device)
    pairs = [*product(HETEROGENEOUS, INDENTERS)][: 1 if run.quick else None]
    rows = []
    for name, indenter in pairs:
        rows.append(run.once(f"{name} {indenter}", partial(compared, name, indenter, run)))
        run.progress(len(rows) / len(pairs))
    return rows


def compared(name: str, indenter: str, run: Run) -> dict[str, Any]:
    """Return the errors of live forces, rms and worst by axis, and the largest forces [N]."""
    each = sensor(name)
    assert each.trajectory is not None
    depth, shear = each.trajectory.depth_max, each.trajectory.shear
    motion = press([depth], shear=shear, angle=ANGLE, steps=STEPS, speed=each.speed)
    tier = Layer() if run.quick else Fem(spacing=SPACING[name], grading=FOR_EDGES)
    row: dict[str, Any] = {"sensor": name, "indenter": indenter}
    row["beside"] = "layer" if run.quick else "fem"
    try:
        force = simulate(each.scene(named(indenter), motion), tier, device=run.device).force
    except SimulationDiverged as diverged:
        return row | {"diverged": str(diverged).partition("\n")[0]}
    off = live_forces(each, named(indenter), motion) - force
    return row | {
        "rms": np.sqrt((off**2).mean(axis=0)).tolist(),
        "worst": np.abs(off).max(axis=0).tolist(),
        "largest": np.abs(force).max(axis=0).tolist(),
    }


def section(rows: list[dict[str, Any]], _: Page) -> str:
    """Return the table of errors of live forces."""
    lines = []
    for row in rows:
        cells = [row.get("diverged", ""), "", "", ""]
        if "rms" in row:
            errors = zip(row["rms"], row["worst"], strict=True)
            cells = [f"{rms:.3f} ({worst:.2f})" for rms, worst in errors]
            cells.append(", ".join(f"{each:.2f}" for each in row["largest"]))
        lines.append([row["sensor"], row["indenter"], row["beside"], *cells])
    head = ["sensor", "indenter", "beside", "Fx", "Fy", "Fz", "largest Fx, Fy, Fz"]
    return f"""## Live forces
Forces of `sim.stream` ({GRID} pixels, {RATE:g} poses a second) beside those of `simulate` for the
same motion: to the sensor's depth, sheared along 17 degrees, back and up. Root mean square (worst)
of the difference [N]; `layer` and live forces take strain as small, `fem` does not.

{table(head, lines)}
"""


def live_forces(each: SimulatedSensor, indenter: Indenter, motion: Motion) -> Array:
    """Return forces (F, 3) [N] at the motion's waypoints, solved at `RATE` in between."""
    live = LivePress(each, indenter)
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
