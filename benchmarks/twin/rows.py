"""Fit of the parameters of the sensors' rows.

1. The prism is pressed, without viscosity, into GelSight, uSkin and TacPalm: force over depth.
2. Ratios of the branches: the press at the row's speed loses the given fraction of its area.
3. Moduli: force is proportional to modulus; at full depth uSkin : GelSight : TacPalm = 4 : 2 : 1.
4. Gains of uSkin: the largest counts of a press and of its shear at the contact points.
5. The viscous presses, loading and unloading, are solved with the rows' values.

A row that differs from its fit by more than 1 % is a failure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Page, Run, table
from benchmarks.twin.relaxation import fitted, hysteresis, relaxed
from sim.device import ready_device
from sim.fem import FOR_EDGES, Fem
from sim.indenters import named
from sim.layer import Layer
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


def measure(run: Run) -> dict[str, Any]:
    """Fit, and solve the viscous presses; a row that is out of date is a failure."""
    ready_device(run.device)
    sensors = {name: sensor(name) for name in FORCES}

    def solved(name: str, scene: Scene) -> Result:
        # A quick run has the pixels of `layer`, whose fits differ.
        fem = Fem(spacing=SPACING[name], grading=FOR_EDGES)
        return simulate(scene, Layer() if run.quick else fem, device=run.device)

    presses = {}
    for name, each in sensors.items():
        presses[name] = solved(name, prism_press(each))
        run.progress(0.15 * len(presses))
    lines = fit_forces(sensors, presses)
    pad = sensors["uskin"]
    lines += fit_gains(pad, [solved("uskin", prism_shear(pad, point)) for point in (1, 2)])
    run.progress(0.6)
    cycles = []
    for name, each in sensors.items():
        depth, force = _curve(solved(name, _cycle(each)))
        cycles.append({"name": name, "force": force.max(), "loss": hysteresis(depth, force)})
        run.progress(0.6 + 0.13 * len(cycles))
    if not run.quick:
        run.failures += [
            f"{line.name}: {line.row:g}, fitted {line.found:g}" for line in lines if not line.agrees
        ]
    return {"lines": [asdict(line) for line in lines], "cycles": cycles}


def section(values: dict[str, Any], _: Page) -> str:
    """Return rows beside fits, and the viscous presses."""
    lines = [
        [each["name"], f"{each['row']:.4g}", f"{each['found']:.4g}"] for each in values["lines"]
    ]
    unit = next(each["force"] for each in values["cycles"] if each["name"] == ANCHOR)
    cycles = [
        [
            each["name"],
            f"{each['force']:.3f} N",
            f"{each['force'] / unit:.3f}",
            f"{100 * each['loss']:.1f} %",
            f"{100 * LOSS[each['name']]:.0f} %",
        ]
        for each in values["cycles"]
    ]
    head = ["viscous press", "force", f"over {ANCHOR}'s", "area lost", "fitted to"]
    return f"""## Parameters of the sensors' rows
The prism is pressed to each sensor's full depth. Ratios of the branches make the press at the row's
speed lose a part of its area; moduli make forces 4 : 2 : 1 (the paper: a TacTip's is a quarter of a
uSkin's and half of a GelSight's); gains give the largest counts.

{table(["parameter", "row", "fitted"], lines)}

The same presses, solved with viscosity down and up, with the rows' values. The fit takes the skin
as quasi-linear:

{table(head, cycles)}
"""


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
