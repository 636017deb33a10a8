"""Collect on wrong benches without a gauge, and compare the true force with the rating.

`python -m benchmarks no-gauge`.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.no_gauge.simulated_bench import SimulatedBench, Stages, Truth
from recorder.command_line.options import whole
from recorder.processes import Workers
from rig.acquire.calibration.store import Calibration
from rig.acquire.no_gauge import find_surface, press_in_steps
from rig.bench.bench import Bench, BenchFile, bench_from
from rig.bench.guards import check_plan, planned_depth, slowed, without_gauge
from rig.bench.worlds import AnalyticSpec, Punch, Sphere
from rig.core.config import read_yaml
from rig.core.errors import ConfigError, DeviceLost, SafetyStop
from rig.core.packaged import BENCHES
from rig.devices.arm.emulated_arm import Wrist
from trajectories import Move, Plan, Target

MM = 1e-3
SENSORS = ("uskin", "gelsight", "uskin", "tacpalm", "uskin")
FAULTS = ("surface", "longer", "tilt", "frozen", "payload", "indenter", "several")
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
    """Largest true force [N]."""
    rating: float
    """Rating of the sensor [N]."""
    stage: str
    """Stage in which it ended."""
    reason: str
    """Message of the stop; empty if the plan was completed."""

    @property
    def fraction(self) -> float:
        """Largest true force as a fraction of the rating."""
        return self.largest / self.rating


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Collects without a gauge on wrong mock benches: surface off by -2 to +1 mm, an indenter "
        "that is 5 mm longer, tilt, a frozen signal, a wrong payload, another indenter, and "
        "several of these. Exit code 1 if the true force ever exceeds the rating of the sensor."
    )
    parser.add_argument("--benches", type=int, default=300, help="number of benches (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first (%(default)s)")
    parser.add_argument(
        "--processes", type=whole(1), default=1, metavar="N", help="benches at once (%(default)s)"
    )
    parser.add_argument("--out", type=Path, help="page to write")


def run(options: argparse.Namespace) -> int:
    """Run the benches, print each and a summary; return 1 if a rating was exceeded."""
    found = []
    for outcome in _outcomes(range(options.seed, options.seed + options.benches), options):
        found.append(outcome)
        print(
            f"{outcome.seed:4d} {outcome.sensor:8} {outcome.fault:8} "
            f"{'wrist' if outcome.wrist else '-':5} {100 * outcome.fraction:5.1f} %  "
            f"{outcome.stage:11} {outcome.reason or 'completed'}",
            flush=True,
        )
    text = page(found)
    print(text)
    if options.out is not None:
        options.out.write_text(text)
    return int(any(outcome.fraction > 1 for outcome in found))


def _outcomes(seeds: Sequence[int], options: argparse.Namespace) -> Iterator[Outcome]:
    """Yield the outcomes in the order of their seeds."""
    if options.processes == 1:
        yield from map(collected, seeds)
        return
    with Workers(options.processes) as workers:
        for waiting in [workers.submit(collected, seed) for seed in seeds]:
            yield waiting.result()


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
            with contextlib.redirect_stdout(io.StringIO()):
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
    plan = _Thinned(bench.trajectory)
    stages("plan", plan, lambda ready: slowed(calibration.applied(ready), depth))


class _Thinned(Plan):
    """Some targets of a plan, evenly spread, with the last and deepest."""

    KIND = "thinned"

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        targets = list(plan.targets())
        kept = targets[:: -max(len(targets) // _TARGETS, 1)][::-1]
        self._targets = [replace(target, index=k) for k, target in enumerate(kept)]

    def __len__(self) -> int:
        return len(self._targets)

    def targets(self) -> Iterator[Target]:
        """Yield the targets."""
        return iter(self._targets)

    def moves(self, target: Target) -> tuple[Move, ...]:
        """Return the moves of a target."""
        return self._plan.moves(target)


def wrong(bench: Bench, fault: str, rng: np.random.Generator, seed: int, *, wrist: bool) -> Truth:
    """Return how a bench with a fault really is.

    Args:
        bench: The bench as its file describes it.
        fault: One of FAULTS.
        rng: Source of the amounts.
        seed: Seed of noise and wrist.
        wrist: True if the arm reports its wrench.
    """
    world = bench.world
    if not isinstance(world, AnalyticSpec):
        raise ConfigError(f"{bench.sensor}: found a simulated world; allowed: an analytic one")
    payload = 0.0
    truth = Truth(world, seed=seed)
    faults = {fault}
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


# First words of a reason, and the guard that they belong to.
_NAMES = (
    ("home: no contact in the signal at", "touch: a point without contact"),
    ("home: no contact", "search: no contact found"),
    ("home: the surface is", "surface: too far from the bench file"),
    ("home: the surface at", "surface: uneven (tilt)"),
    ("home: the interval", "surface: interval too wide"),
    ("newest signal that changed", "signal: frozen"),
    ("newest signal", "signal: silent"),
    ("signal:", "signal: too large"),
    ("contact where none", "signal: contact on the way to a point"),
    ("wrench of the arm", "wrench of the arm"),
    ("TCP outside", "depth"),
    ("the tip is", "depth"),
    ("point", "signal: contact above a point"),
)


def name_of(reason: str) -> str:
    """Return the guard that stopped a bench, by its message."""
    if not reason:
        return "completed"
    return next((name for start, name in _NAMES if reason.startswith(start)), reason)


def page(found: list[Outcome]) -> str:
    """Return the summary as Markdown."""
    worst = max(found, key=lambda each: each.fraction)
    over = [each.seed for each in found if each.fraction > 1]
    lines = [
        "# Wrong benches without a gauge",
        "",
        f"{len(found)} mock benches by `python -m benchmarks no-gauge --benches {len(found)} "
        f"--seed {found[0].seed}`, on a simulated clock. The true force exceeded the rating of the "
        f"sensor on {len(over)} of them; the largest was {100 * worst.fraction:.0f} % of it (seed "
        f"{worst.seed}: {worst.sensor}, {worst.fault}).",
        "",
        "Each bench finds its surface, presses in steps and presses targets spread over its plan. "
        "Samples reach the guards late: images 90 ms, taxels 30 ms, the wrench 12 ms, this with "
        "a gain that is wrong by up to 30 %, a bias and a drift. A wrong indenter is a punch or a "
        "sphere of 1 to 5 mm; `several` are three faults at once.",
        "",
        "| fault | benches | largest force, % of rating | ended by |",
        "|---|---|---|---|",
    ]
    for fault in FAULTS:
        rows = [each for each in found if each.fault == fault]
        if not rows:
            continue
        ends = Counter(name_of(each.reason) for each in rows)
        text = ", ".join(f"{name} {count}" for name, count in ends.most_common())
        largest = 100 * max(each.fraction for each in rows)
        lines.append(f"| {fault} | {len(rows)} | {largest:.0f} | {text} |")
    without = [each.fraction for each in found if not each.wrist]
    if without:
        lines += [
            "",
            f"Without the arm's wrench ({len(without)} benches): {100 * max(without):.0f} %.",
        ]
    return "\n".join(lines) + "\n"
