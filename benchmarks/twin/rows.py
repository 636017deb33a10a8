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
from scipy.optimize import brentq

from benchmarks.report import Page, Run, table
from sim.device import ready_device
from sim.errors import SceneError
from sim.fem import FOR_EDGES, Fem
from sim.indenters import named
from sim.layer import Layer
from sim.result import Result
from sim.scene import Motion, Scene, Viscosity, through
from sim.sensors.field import SurfaceField
from sim.sensors.sensor import SimulatedSensor, sensor
from sim.sensors.taxels import TaxelPad, TaxelSignal
from sim.tiers import simulate
from sim.twin.model import relaxing

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
# Number of steps of loading, and of unloading, of a relaxed press.
CYCLE = 400
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
        depth, force = _curve(
            solved(name, each.scene(named("prism"), _motion(each, there_and_back=True)))
        )
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
        row = each.effects.viscosity
        assert row is not None
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
    assert isinstance(pad.signal, TaxelSignal)
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
    assert plan is not None
    x, y = plan.position(point)
    deep = (x, y, -plan.depth_max)
    aside = (x + plan.shear, y, -plan.depth_max)
    motion = through([(x, y, 0.0), deep, aside], speed=pad.speed)
    scene = pad.scene(named("prism"), motion)
    return replace(scene, effects=replace(scene.effects, viscosity=None))


def _motion(each: SimulatedSensor, *, there_and_back: bool = False) -> Motion:
    plan = each.force_depth
    assert plan is not None
    depths = [plan.depth_max * index / STEPS for index in range(STEPS + 1)]
    if there_and_back:
        depths += depths[-2::-1]
    return through([(0.0, 0.0, -depth) for depth in depths], speed=each.speed)


def _curve(result: Result) -> tuple[Array, Array]:
    """Return the depths and pressing forces of a press."""
    return -np.array(result.scene.motion.tip)[:, 2], -result.force[:, 2]


def hysteresis(depth: Array, force: Array) -> float:
    """Return the area between loading and unloading over the area under loading.

    Args:
        depth: Depths of the tip (n,) [m], rising once to the largest and then decreasing.
        force: Pressing forces (n,) [N].

    Raises:
        SceneError: Depths that do not increase once and then decrease once.
    """
    deepest = int(depth.argmax())
    turns = np.diff(depth)
    if not ((turns[:deepest] > 0).all() and (turns[deepest:] < 0).all() and deepest > 0):
        raise SceneError(f"depth: {depth!r}; allowed: down once, then up once [m]")
    loading = np.trapezoid(force[: deepest + 1], depth[: deepest + 1])
    unloading = -np.trapezoid(force[deepest:], depth[deepest:])
    return float((loading - unloading) / loading)


def relaxed(
    depth: Array, force: Array, viscosity: Viscosity, *, speed: float
) -> tuple[Array, Array]:
    """Return depth and force of loading and unloading at `speed` [m/s], from an elastic press.

    Force is that of an elastic body plus the decaying force of each branch: F(t) = F_e(t) + sum
    ratio int_0^t exp(-(t - s) / time) dF_e(s), and 0 once the indenter has left the skin (F < 0).
    This is exact for a linear layer with constant contact area (Lee & Radok 1960), as under a flat
    punch; for other indenters `fit` solves the same press to measure the difference.

    Args:
        depth: Depths of the elastic press, from 0 to the deepest (n,) [m].
        force: Pressing forces (n,) [N].
        viscosity: Prony branches.
        speed: Speed of the tip.
    """
    down = np.linspace(0.0, depth[-1], CYCLE + 1)
    way = np.concatenate([down, down[-2::-1]])
    elastic = np.interp(way, depth, force)
    at = np.arange(len(way)) * (depth[-1] / CYCLE / speed)
    branches = [
        ratio * relaxing(at, elastic[:, None], time)[:, 0]
        for ratio, time in zip(viscosity.ratios, viscosity.times, strict=True)
    ]
    return way, np.maximum(elastic + np.sum(branches, axis=0), 0.0)


def fitted(
    depth: Array, force: Array, times: tuple[float, ...], *, speed: float, fraction: float
) -> Viscosity:
    """Return branches of these times [s] with equal ratios that lose `fraction` of a press's area.

    Raises:
        SceneError: No ratio up to 10 loses as much.
    """

    def with_ratio(ratio: float) -> Viscosity:
        return Viscosity(ratios=(ratio,) * len(times), times=times)

    def excess(ratio: float) -> float:
        return hysteresis(*relaxed(depth, force, with_ratio(ratio), speed=speed)) - fraction

    if not excess(0.0) < 0 < excess(10.0):
        raise SceneError(
            f"fraction: {fraction!r}; allowed with times {times!r} s at {speed:g} m/s: above 0, "
            "below "
            f"{excess(10.0) + fraction:.3f}"
        )
    return with_ratio(float(brentq(excess, 0.0, 10.0, xtol=1e-6)))
