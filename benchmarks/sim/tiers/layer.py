"""Accuracy and speed of the `layer` tier, on one grid: `python -m benchmarks layer`."""

from __future__ import annotations

import argparse
import time
from itertools import pairwise

import numpy as np

from benchmarks.sim.reference_solutions import layer_sphere
from sim.effects import Effects, Friction, Viscosity
from sim.indenters import sphere
from sim.layer import Layer
from sim.layer.solver import LayerPress, simulate_layer
from sim.layer.spectral import Grid
from sim.scene import Body, Motion, Scene, press, through

# Places of the spheres [m]: on a corner of four pixels, and off it.
PLACES = ((0.0, 0.0), (0.13e-3, -0.21e-3), (1.037e-3, 0.512e-3))
RADII = (2e-3, 4e-3, 10e-3)
DEPTHS = (0.5e-3, 1.0e-3, 1.5e-3)
# Speed of the tip [m/s].
SPEED = 10e-3
# Frames per second of the motion.
RATE = 60.0
DEPTH, SHEAR = 1.2e-3, 1.0e-3
EFFECTS = {
    "frictionless": Effects(),
    "friction 0.3": Effects(friction=Friction(0.3)),
    "friction 0.8": Effects(friction=Friction(0.8)),
    "friction 0.8, viscous": Effects(
        friction=Friction(0.8), viscosity=Viscosity((0.5, 0.3), (0.05, 0.5))
    ),
}


def errors(layer: Layer) -> list[str]:
    """Return a line for each sphere and depth: force, and its largest error over all places."""
    body = Body()
    lines = ["sphere mm  depth mm  exact N   layer N   worst error"]
    for radius in RADII:
        found = np.array(
            [
                -simulate_layer(
                    Scene(sphere(radius), press(DEPTHS, at=place), body=body),
                    layer,
                ).force[1:, 2]
                for place in PLACES
            ]
        )
        for index, depth in enumerate(DEPTHS):
            exact = layer_sphere(depth, radius, body.thickness, body.modulus, body.poisson).force
            error = found[:, index] / exact - 1
            worst = error[np.abs(error).argmax()]
            lines.append(
                f"{radius * 1e3:9.4g}  {depth * 1e3:8.4g}  {exact:.5f}  {found[0, index]:8.5f}  "
                f"{100 * worst:+10.3f} %"
            )
    return lines


def rates(layer: Layer, repeats: int) -> list[str]:
    """Return a line for each set of effects: CPU time per frame of a press, shear and return."""
    lines = ["effects                frames  steps  mean ms  worst ms  frames/s  worst frames/s"]
    motion = down_aside_back_up()
    for name, effects in EFFECTS.items():
        runs = [_timed(Scene(sphere(4e-3), motion, effects=effects), layer)]
        runs += [
            _timed(Scene(sphere(4e-3), motion, effects=effects), layer) for _ in range(repeats - 1)
        ]
        seconds = np.min([run[0] for run in runs], axis=0)
        mean, worst = seconds.mean() * 1e3, seconds.max() * 1e3
        lines.append(
            f"{name:21}  {len(seconds):6}  {runs[0][1]:5}  {mean:7.1f}  {worst:8.1f}  "
            f"{1e3 / mean:8.0f}  {1e3 / worst:14.0f}"
        )
    return lines


def down_aside_back_up() -> Motion:
    """Return the motion that is timed: `RATE` frames a second at `SPEED`, from touch to lift."""
    corners = np.array([(0, 0, 0), (0, 0, -DEPTH), (SHEAR, 0, -DEPTH), (0, 0, -DEPTH), (0, 0, 0)])
    points = [corners[0]]
    for start, end in pairwise(corners):
        count = round(float(np.linalg.norm(end - start)) / SPEED * RATE)
        points += [start + (end - start) * part for part in np.arange(1, count + 1) / count]
    tips = [(float(x), float(y), float(z)) for x, y, z in points]
    return through(tips, speed=SPEED)


def _timed(scene: Scene, layer: Layer) -> tuple[list[float], int]:
    """Return the CPU time of each frame [s], and the total number of steps."""
    state = LayerPress(scene, Grid(scene.body, layer.grid), layer.tolerance)
    seconds, before = [], 0.0
    for tip, now in zip(scene.motion.tip, scene.motion.time, strict=True):
        start = time.process_time()
        state.move(np.array(tip), now - before)
        seconds.append(time.process_time() - start)
        before = now
    return seconds, state.spent.steps


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    default = Layer()
    parser.add_argument(
        "--grid",
        type=int,
        default=default.grid,
        help="pixels along the longer side (default %(default)s)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=default.tolerance,
        help="residual of the contact (default %(default)s)",
    )
    parser.add_argument(
        "--repeats",
        type=int,
        default=3,
        help="number of runs, of which each frame's fastest counts (default %(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Print both tables."""
    layer = Layer(options.grid, options.tolerance)
    body = Body()
    millimetres = " x ".join(
        f"{size * 1e3:g}" for size in (body.size_x, body.size_y, body.thickness)
    )
    print(f"body {millimetres} mm, grid {options.grid}, tolerance {options.tolerance:g}\n")
    print("\n".join(errors(layer)), end="\n\n")
    print(
        f"sphere R = 4 mm: {DEPTH * 1e3:g} mm down, {SHEAR * 1e3:g} mm aside, back, up at "
        f"{SPEED * 1e3:g} mm/s, {RATE:g} frames a second; CPU time of one thread"
    )
    print("\n".join(rates(layer, options.repeats)))
    return 0
