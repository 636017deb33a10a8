"""Part `no-gauge`: does the true force stay below the rating on wrong benches without a gauge?"""

import contextlib
import io
import math
import tempfile
from collections import Counter
from dataclasses import replace
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
from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, RED, chart
from rig.acquire.calibration.store import Calibration
from rig.acquire.collector import CollectRequest
from rig.acquire.no_gauge import find_surface, press_in_steps
from rig.bench.bench import Bench, BenchFile, bench_from
from rig.bench.guards import slowed, without_gauge
from rig.bench.indenter import paper_indenters
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


def measure(run: Run) -> dict[str, Any]:
    """Collect on each wrong bench; return the largest forces and the ends, by fault."""
    each = len(SENSORS)
    run.seeds = range(each, each * (QUICK_COUNT + 1), each) if run.quick else range(COUNT)
    rows = rows_of(run, collected, {f"seed {seed}": seed for seed in run.seeds})
    run.failures += [
        f"{seed}: {one['fraction']:.0%} of the rating of {one['sensor']} ({one['fault']})"
        for seed, one in rows.items()
        if one["fraction"] > 1
    ]
    worst = max(rows, key=lambda seed: rows[seed]["fraction"])
    bare = [one["fraction"] for one in rows.values() if not one["wrist"]]
    by_fault = {fault: [one for one in rows.values() if one["fault"] == fault] for fault in FAULTS}
    return {
        "benches": len(rows),
        "largest": rows[worst]["fraction"],
        "worst": f"{worst}: {rows[worst]['sensor']}, {rows[worst]['fault']}",
        "without_wrench": [len(bare), max(bare, default=0.0)],
        "faults": {
            fault: {
                "benches": len(ones),
                "largest": max(one["fraction"] for one in ones),
                "ends": Counter(one["end"] for one in ones),
            }
            for fault, ones in by_fault.items()
            if ones
        },
    }


def collected(seed: int) -> dict[str, Any]:
    """Find the surface, press in steps and press the plan on the wrong bench of a seed.

    Return its sensor, its fault, whether its arm reports the wrench, the largest true force over
    the sensor's rating, and its end: `completed`, or the stage in which it was stopped.
    """
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
    with tempfile.TemporaryDirectory(prefix="no-gauge-") as folder:
        clock = SimulatedBench(bench, truth, Path(folder))
        stages = Stages(clock)
        try:
            with contextlib.redirect_stdout(out := io.StringIO()), contextlib.redirect_stderr(out):
                _collect(BenchFile(Path(sensor), content, bench), stages)
            end = "completed"
        except (ConfigError, SafetyStop, DeviceLost):
            end = f"stopped in {stages.stage or 'plan check'}"
    fraction = clock.largest / (bench.limits.sensor_rating or math.nan)
    row = {"sensor": sensor, "fault": fault, "wrist": has_wrist}
    return row | {"fraction": float(fraction), "end": end}


def _collect(file: BenchFile, stages: Stages) -> None:
    bench = file.bench
    request = CollectRequest.of(bench, Path("plan.zarr"))
    depth = request.depth(bench)
    calibration = Calibration(find_surface(file, stages), file="found in the same run")
    press_in_steps(bench, calibration, depth, stages, lambda lines: None)
    # Some targets of the plan, evenly spread, with the last and deepest.
    targets = request.to_press(0)
    some = targets[:: -max(len(targets) // _TARGETS, 1)][::-1]

    def prepared(ready: Bench) -> Bench:
        return slowed(calibration.applied(ready), depth)

    stages("plan", bench.trajectory, prepared, targets=some)


def wrong(bench: Bench, fault: str, rng: np.random.Generator, seed: int, *, wrist: bool) -> Truth:
    """Return how a bench is whose file is wrong by one of FAULTS; `seed` is of noise and wrist."""
    world = bench.world
    assert world is not None
    faults = [fault]
    if fault == "several":
        faults = rng.choice(FAULTS[:-1], 3, replace=False).tolist()
    changes: dict[str, Any] = {}
    payload = 0.0
    if "surface" in faults:
        changes["surface"] = MM * rng.uniform(-2.0, 1.0)
    if "longer" in faults:
        changes["longer"] = 5 * MM
    if "tilt" in faults:
        turn = rng.uniform(0, 2 * math.pi)
        angle = math.radians(rng.uniform(0.5, 8.0))
        changes["tilt"] = (angle * math.cos(turn), angle * math.sin(turn))
    if "frozen" in faults:
        changes["frozen_at"] = float(rng.uniform(1.0, 160.0))
        changes["silent"] = bool(rng.random() < 0.3)
    if "payload" in faults:
        payload = float(rng.uniform(-1.0, 1.0))
    if "indenter" in faults:
        changes["indenter"] = str(rng.choice(sorted(paper_indenters())))
    wrench = Wrist(seed, payload) if wrist else None
    return Truth(world, seed=seed, wrist=wrench, **changes)


def section(values: dict[str, Any], page: Page) -> str:
    """Return the largest forces and the ends by fault, as table and chart."""
    faults = values["faults"]
    with chart(page.picture("force"), 8, 0.9 + 0.3 * len(faults)) as figure:
        axes = figure.subplots()
        axes.barh(list(faults), [100 * one["largest"] for one in faults.values()], color=BLUE)
        axes.axvline(100, color=RED)
        axes.annotate("rating", (99, len(faults) - 0.6), color=RED, ha="right")
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
to 8 degrees, its signal frozen or silent, the payload wrong, another one of the
paper's indenters; `several` are three at once.

{page.link("force", "Largest true force, by fault")}

{table(("fault", "ended by", "benches", "largest force"), rows)}"""
