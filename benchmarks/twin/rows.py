"""Fit of the sensors' parameters: `python -m benchmarks sensor-fit [--finer] [--check]`.

1. The prism is pressed, without viscosity, into GelSight, uSkin and TacPalm: force over depth.
2. Ratios of the branches: the press at the row's speed loses the given fraction of its area.
3. Moduli: force is proportional to modulus; at full depth uSkin : GelSight : TacPalm = 4 : 2 : 1.
4. Gains of uSkin: the largest counts of a press and of its shear at the contact points.

It prints the fitted values next to those of the rows, and fails if they differ by more than 1 %.
`--finer` uses elements of two thirds the size; `--check` solves the viscous presses, loading and
unloading, with the rows' values.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.twin.relaxation import fitted, hysteresis, relaxed
from recorder.command_line.options import add_device
from sim.device import ready_device
from sim.fem import FOR_EDGES, Fem
from sim.indenters import named
from sim.result import Result
from sim.scene import Motion, Scene, Viscosity, through
from sim.sensors.field import SurfaceField
from sim.sensors.sensor import SimulatedSensor, sensor
from sim.sensors.taxels import TaxelPad, TaxelSignal
from sim.tiers import simulate

Array = NDArray[np.float64]

# Ratios of the prism's force at full depth (paper: TacTip's is four times below uSkin's and two
# times below GelSight's).
FORCES = {"uskin": 4.0, "gelsight": 2.0, "tacpalm": 1.0}
# Sensor whose modulus is given.
ANCHOR = "gelsight"
# Fraction of the press's area that is lost; assumed, within 10 to 20 %.
LOSS = {"uskin": 0.12, "gelsight": 0.15, "tacpalm": 0.15}
# Largest counts along z, and along x or y, of presses with the trajectory's full depth and shear:
# discs grow 8 times, to 2,300 points^2, and move by 0.4 of their pitch, but do not touch.
COUNTS_NORMAL, COUNTS_SHEAR = 10_000.0, 2_000.0
# Element height [m]; at the indenter elements are half as wide.
SPACING = {"uskin": 0.667e-3, "gelsight": 0.667e-3, "tacpalm": 1.2e-3}
# Number of frames of a press.
STEPS = 8
# Relative difference above which a row is out of date.
AGREED = 0.01


@dataclass(frozen=True, slots=True)
class Line:
    """One fitted parameter."""

    name: str
    row: float
    """Value in the row."""
    found: float

    @property
    def agrees(self) -> bool:
        """True if the row is up to date."""
        return abs(self.row / self.found - 1) <= AGREED


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--finer", action="store_true", help="elements of two thirds the size")
    parser.add_argument("--check", action="store_true", help="solve the viscous presses as well")
    add_device(parser)


def run(options: argparse.Namespace) -> int:
    """Fit, print and compare with the rows; return 1 if they differ."""
    ready_device(options.device)
    sensors = {name: sensor(name) for name in FORCES}

    def solved(name: str, scene: Scene) -> Result:
        size = SPACING[name] * (2 / 3 if options.finer else 1.0)
        return _solved(name, scene, Fem(spacing=size, grading=FOR_EDGES), options.device)

    presses = {name: solved(name, prism_press(each)) for name, each in sensors.items()}
    lines = fit_forces(sensors, presses)
    pad = sensors["uskin"]
    lines += fit_gains(pad, [solved("uskin", prism_shear(pad, point)) for point in (1, 2)])
    print(f"\n{'':42} {'row':>10} {'fitted':>10}")
    for line in lines:
        mark = "" if line.agrees else "   <- differs"
        print(f"{line.name:42} {line.row:10.4g} {line.found:10.4g}{mark}")
    if options.check:
        cycles = {name: solved(name, _cycle(each)) for name, each in sensors.items()}
        print_cycles(cycles)
    return 0 if all(line.agrees for line in lines) else 1


def fit_forces(sensors: dict[str, SimulatedSensor], presses: dict[str, Result]) -> list[Line]:
    """Fit ratios and moduli from elastic presses with the rows' moduli."""
    lines, peaks = [], {}
    for name, each in sensors.items():
        depth, force = _curve(presses[name])
        row = _branches(each)
        branches = fitted(depth, force, row.times, speed=each.speed, fraction=LOSS[name])
        peaks[name] = float(relaxed(depth, force, branches, speed=each.speed)[1].max())
        lines += [
            Line(f"{name}: ratio of the branch of {time:g} s", ratio, found)
            for time, ratio, found in zip(row.times, row.ratios, branches.ratios, strict=True)
        ]
    unit = peaks[ANCHOR] / FORCES[ANCHOR]
    for name, each in sensors.items():
        wanted = FORCES[name] * unit
        kpa = each.body.modulus / 1e3
        lines.append(Line(f"{name}: modulus [kPa]", kpa, kpa * wanted / peaks[name]))
    return lines


def fit_gains(pad: SimulatedSensor, results: Sequence[Result]) -> list[Line]:
    """Fit the gains of uSkin from presses that end in a shear at several contact points."""
    if not isinstance(pad.signal, TaxelSignal):
        raise TypeError(f"{pad.name}: {type(pad.signal).__name__}; allowed: a pad of taxels")
    taxels = TaxelPad(pad.body, pad.signal)
    flux = np.concatenate([taxels.change(SurfaceField.of(result)) for result in results])
    normal = COUNTS_NORMAL / float(flux[..., 2].max())
    shear = COUNTS_SHEAR / float(np.abs(flux[..., :2]).max())
    return [
        Line("uskin: gain_normal [counts/mT]", pad.signal.gain_normal / 1e3, normal / 1e3),
        Line("uskin: gain_shear [counts/mT]", pad.signal.gain_shear / 1e3, shear / 1e3),
    ]


def print_cycles(results: dict[str, Result]) -> None:
    """Print force and loss of the prism's loading and unloading, solved with the rows' values."""
    print(f"\n{'solved with viscosity':42} {'force [N]':>10} {'part':>10} {'loss':>10}")
    unit = _curve(results[ANCHOR])[1].max() / FORCES[ANCHOR]
    for name, result in results.items():
        depth, force = _curve(result)
        lost = hysteresis(depth, force)
        print(f"{name:42} {force.max():10.3f} {force.max() / unit:10.3f} {lost:10.3f}")


def prism_press(each: SimulatedSensor) -> Scene:
    """Return the press of the prism to full depth, without viscosity."""
    scene = each.scene(named("prism"), _motion(each))
    return replace(scene, effects=replace(scene.effects, viscosity=None))


def prism_shear(pad: SimulatedSensor, point: int) -> Scene:
    """Return the press of the prism to full depth at a contact point, with full shear along x."""
    plan = pad.trajectory
    if plan is None:
        raise TypeError(f"{pad.name}: no trajectory; allowed: a pad with one")
    x, y = plan.position(point)
    deep = (x, y, -plan.depth_max)
    aside = (x + plan.shear, y, -plan.depth_max)
    motion = through([(x, y, 0.0), deep, aside], speed=pad.speed)
    scene = pad.scene(named("prism"), motion)
    return replace(scene, effects=replace(scene.effects, viscosity=None))


def _cycle(each: SimulatedSensor) -> Scene:
    """Return the press of the prism to full depth and back."""
    return each.scene(named("prism"), _motion(each, there_and_back=True))


def _motion(each: SimulatedSensor, *, there_and_back: bool = False) -> Motion:
    plan = each.force_depth
    if plan is None:
        raise TypeError(f"{each.name}: no force-depth press; allowed: a sensor with one")
    depths = [plan.depth_max * index / STEPS for index in range(STEPS + 1)]
    if there_and_back:
        depths += depths[-2::-1]
    return through([(0.0, 0.0, -depth) for depth in depths], speed=each.speed)


def _branches(each: SimulatedSensor) -> Viscosity:
    if each.effects.viscosity is None:
        raise TypeError(f"{each.name}: no viscosity; allowed: a sensor with one")
    return each.effects.viscosity


def _curve(result: Result) -> tuple[Array, Array]:
    """Return the depths and pressing forces of a press."""
    return -np.array(result.scene.motion.tip)[:, 2], -result.force[:, 2]


def _solved(name: str, scene: Scene, numerics: Fem, device: str) -> Result:
    """Solve a scene and report when it is done.

    Raises:
        SimulationDiverged: No solution.
    """
    result = simulate(scene, numerics, device=device)
    print(f"solved: {name}, {len(scene.motion)} frames", file=sys.stderr)
    return result
