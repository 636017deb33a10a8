"""Live forces compared with `layer` and `fem`: `python -m benchmarks live-forces`.

Sphere, prism and cylinder are pressed to the sensor's depth, sheared, returned and lifted, with the
sensor's friction, viscosity and speed. `live` receives a pose 60 times a second; `layer` and `fem`
receive the frames that are compared. Takes minutes per indenter, nearly all of them for `fem`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.twin.rows import SPACING
from recorder.command_line.options import add_device
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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("--sensors", nargs="+", default=HETEROGENEOUS, choices=HETEROGENEOUS)
    parser.add_argument("--indenters", nargs="+", default=INDENTERS)
    parser.add_argument(
        "--grid", type=int, default=GRID, help="grid of the live sensor (%(default)s)"
    )
    add_device(parser, "device of `fem`")


def run(options: argparse.Namespace) -> int:
    """Solve, compare and print."""
    ready_device(options.device)
    print(f"{'':28} {'largest force [N]':>21}   {'rms error [N]':>20}   {'worst error [N]':>20}")
    for name in options.sensors:
        for indenter in options.indenters:
            each, body = sensor(name), named(indenter)
            for line in lines(each, body, options.grid, options.device):
                print(line, flush=True)
    return 0


def lines(each: SimulatedSensor, indenter: Indenter, grid: int, device: str) -> Iterator[str]:
    """Yield one line for each solution that the live forces are compared with."""
    motion = way(each)
    scene = each.scene(indenter, motion)
    live = live_forces(each, indenter, motion, grid)
    title = f"{each.name} {indenter.name}"
    yield _line(f"{title}: layer", live, simulate(scene, Layer()).force)
    numerics = Fem(spacing=SPACING[each.name], grading=FOR_EDGES)
    try:
        solved = simulate(scene, numerics, device=device).force
    except SimulationDiverged as error:
        yield f"{title}: fem: {error}"
    else:
        yield _line(f"{title}: fem", live, solved)


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
            time = before + (now - before) * part
            tip = np.array([np.interp(time, times, axis) for axis in tips.T])
            live.move(tip, (now - before) / turns)
        forces.append(live.wrench[:3])
        before = now
    return np.array(forces)


def _line(title: str, live: Array, other: Array) -> str:
    error = live - other
    parts = (
        np.abs(other).max(axis=0),
        np.sqrt((error**2).mean(axis=0)),
        np.abs(error).max(axis=0),
    )
    numbers = "   ".join(" ".join(f"{value:6.3f}" for value in part) for part in parts)
    return f"{title:28} {numbers}"
