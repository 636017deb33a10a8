"""Part `no-gauge`: does the true force stay below the rating on wrong benches without a gauge?"""

from __future__ import annotations

import contextlib
import io
import math
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults.simulated_bench import (
    CAMERA_DELAY,
    TAXELS_DELAY,
    WRENCH_DELAY,
    SimulatedBench,
    Stages,
    Truth,
)
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, RED, chart
from recorder.processes import Workers, cores
from rig.acquire.calibration.store import Calibration
from rig.acquire.no_gauge import find_surface, press_in_steps
from rig.bench.bench import Bench, BenchFile, bench_from
from rig.bench.guards import check_plan, planned_depth, slowed, without_gauge
from rig.bench.worlds import AnalyticSpec, Punch, Sphere
from rig.core.config import read_yaml
from rig.core.errors import ConfigError, DeviceLost, SafetyStop
from rig.core.packaged import BENCHES
from rig.devices.arm.emulated_arm import Wrist

MM = 1e-3
SENSORS = ("uskin", "gelsight", "uskin", "tacpalm", "uskin")
FAULTS = ("surface", "longer", "tilt", "frozen", "payload", "indenter", "several")
# Benches of a complete and of a quick run, whose sensors have no camera and whose faults differ.
COUNT, QUICK_COUNT = 300, 3
# Targets of the plan that are pressed after the first press, one at each of five points.
_TARGETS = 5


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of one wrong bench."""

    seed: int
    sensor: str
    fault: str
    wrist: bool
    """True if the arm reports its wrench."""
    largest: float
    rating: float
    """Largest true force, and rating of the sensor [N]."""
    stage: str
    reason: str
    """Stage in which it ended, and why; empty if the plan was completed."""

    @property
    def fraction(self) -> float:
        """Largest true force as a fraction of the rating."""
        return self.largest / self.rating


def measure(run: Run) -> dict[str, Any]:
    """Collect on each wrong bench; return the largest forces and the ends, by fault."""
    count = QUICK_COUNT if run.quick else COUNT
    outcomes: list[Outcome] = []
    each = len(SENSORS)
    run.seeds = range(each, each * (count + 1), each) if run.quick else range(count)
    with Workers(cores()) as workers:
        for waiting in [workers.submit(collected, seed) for seed in run.seeds]:
            outcomes.append(waiting.result())
            run.progress(len(outcomes) / count)
    run.failures += [
        f"seed {one.seed}: {one.fraction:.0%} of the rating of {one.sensor} ({one.fault})"
        for one in outcomes
        if one.fraction > 1
    ]
    return summary_of(outcomes)


def summary_of(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return the number of benches, the largest force as a fraction, and the ends, by fault."""
    by_fault = {fault: [one for one in outcomes if one.fault == fault] for fault in FAULTS}
    worst = max(outcomes, key=lambda one: one.fraction)
    return {
        "benches": len(outcomes),
        "largest": worst.fraction,
        "worst": f"seed {worst.seed}: {worst.sensor}, {worst.fault}",
        "without_wrench": [
            sum(not one.wrist for one in outcomes),
            max((one.fraction for one in outcomes if not one.wrist), default=0.0),
        ],
        "faults": {
            fault: {
                "benches": len(ones),
                "largest": max(one.fraction for one in ones),
                "ends": Counter(
                    f"stopped in {one.stage}" if one.reason else "completed" for one in ones
                ),
            }
            for fault, ones in by_fault.items()
            if ones
        },
    }


def collected(seed: int) -> Outcome:
    """Find the surface, press in steps and press the plan on the wrong bench of a seed."""
    rng = np.random.default_rng(seed)
    sensor = SENSORS[seed % len(SENSORS)]
    fault = FAULTS[seed // len(SENSORS) % len(FAULTS)]
    content = without_gauge(read_yaml(BENCHES / f"{sensor}.yaml", BENCHES), sensor)
    has_wrist = bool(rng.random() < 0.75)
    if not has_wrist:
        content["streams"] = {}
    bench = bench_from(content, sensor)
    # A lower retract makes the benches faster; the search begins 8 mm above the surface.
    arm = replace(bench.arm, retract=10 * MM)
    bench = replace(bench, arm=arm, limits=replace(bench.limits, duration_max=36000.0))
    truth = wrong(bench, fault, rng, seed, wrist=has_wrist)
    rating = bench.limits.sensor_rating or math.nan
    with tempfile.TemporaryDirectory(prefix="no-gauge-") as folder:
        clock = SimulatedBench(bench, truth, Path(folder))
        stages = Stages(clock)
        reason = ""
        try:
            with contextlib.redirect_stdout(out := io.StringIO()), contextlib.redirect_stderr(out):
                _collect(BenchFile(Path(sensor), content, bench), stages)
        except (ConfigError, SafetyStop, DeviceLost) as error:
            reason = str(error)
    return Outcome(
        seed, sensor, fault, has_wrist, clock.largest, rating, stages.stage or "plan check", reason
    )


def _collect(file: BenchFile, stages: Stages) -> None:
    bench = file.bench
    depth = planned_depth(bench, bench.trajectory)
    check_plan(bench, depth)
    home = find_surface(file, stages)
    calibration = Calibration(home, file="found in the same run")
    press_in_steps(bench, calibration, depth, stages, lambda lines: None)
    # Some targets of the plan, evenly spread, with the last and deepest.
    targets = list(bench.trajectory.targets())
    some = targets[:: -max(len(targets) // _TARGETS, 1)][::-1]

    def prepared(ready: Bench) -> Bench:
        return slowed(calibration.applied(ready), depth)

    stages("plan", bench.trajectory, prepared, targets=some)


def wrong(bench: Bench, fault: str, rng: np.random.Generator, seed: int, *, wrist: bool) -> Truth:
    """Return how a bench is whose file is wrong by one of FAULTS; `seed` is of noise and wrist."""
    world = bench.world
    if not isinstance(world, AnalyticSpec):
        raise ConfigError(f"{bench.sensor}: found a simulated world; allowed: an analytic one")
    payload, truth, faults = 0.0, Truth(world, seed=seed), {fault}
    if fault == "several":
        faults = set(rng.choice(FAULTS[:-1], 3, replace=False).tolist())
    if "surface" in faults:
        truth = replace(truth, surface=MM * rng.uniform(-2.0, 1.0))
    if "longer" in faults:
        truth = replace(truth, longer=5 * MM)
    if "tilt" in faults:
        turn = rng.uniform(0, 2 * math.pi)
        angle = math.radians(rng.uniform(0.5, 8.0))
        truth = replace(truth, tilt=(angle * math.cos(turn), angle * math.sin(turn)))
    if "frozen" in faults:
        at = float(rng.uniform(1.0, 160.0))
        truth = replace(truth, frozen_at=at, silent=bool(rng.random() < 0.3))
    if "payload" in faults:
        payload = float(rng.uniform(-1.0, 1.0))
    if "indenter" in faults:
        radius = MM * rng.uniform(1.0, 5.0)
        shape = Punch(radius) if rng.random() < 0.5 else Sphere(radius)
        truth = replace(truth, world=replace(world, indenter=shape))
    return replace(truth, wrist=Wrist(seed, payload) if wrist else None)


def section(values: dict[str, Any], page: Page) -> str:
    """Return the largest forces and the ends by fault, as table and chart."""
    faults = values["faults"]
    with chart(page.picture("force"), 8, 0.9 + 0.3 * len(faults)) as figure:
        axes = figure.subplots()
        axes.barh(list(faults), [100 * one["largest"] for one in faults.values()], color=BLUE)
        axes.axvline(100, color=RED)
        axes.set(xlabel="largest true force [% of the rating]", xlim=(0, 105))
        axes.invert_yaxis()
    rows = [
        (
            fault,
            ", ".join(f"{end} {count}" for end, count in Counter(one["ends"]).most_common()),
            one["benches"],
            f"{one['largest']:.0%}",
        )
        for fault, one in faults.items()
    ]
    bare, most = values["without_wrench"]
    return f"""## Wrong benches without a gauge

{values["benches"]} mock benches on a simulated clock, {bare} of them without the arm's wrench. The
true force reached at most {values["largest"]:.0%} of the sensor's rating ({values["worst"]}), and
{most:.0%} without the wrench.

Each bench finds its surface, presses in steps and presses targets spread over its plan. Samples
reach the guards late: images {1e3 * CAMERA_DELAY:.0f} ms, taxels {1e3 * TAXELS_DELAY:.0f} ms, the
wrench {1e3 * WRENCH_DELAY:.0f} ms, this with a gain that is wrong by up to 30 %, a bias and a
drift. Faults: the surface is off by -2 to +1 mm, the indenter 5 mm longer, the sensor tilted by up
to 8 degrees, its signal frozen or silent, the payload wrong, the indenter a punch or sphere of 1 to
5 mm; `several` are three at once.

{page.link("force", "Largest true force, by fault")}

{table(("fault", "ended by", "benches", "largest force"), rows)}"""
