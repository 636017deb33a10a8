"""Check the stated error of leaving effects out, on random scenes.

`python -m benchmarks needed` plans each scene, solves it with all effects and without the neglected
ones on the same default mesh, and compares. Times are valid from the second run on, because the
first one compiles kernels.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.hard_cases.random_scenes.dice import Dice
from benchmarks.hard_cases.random_scenes.scenes import drawn
from benchmarks.processes import INTERRUPTED, done_counts, side_by_side
from benchmarks.sim.accuracy.errors import worst_errors
from recorder.command_line.options import add_seed
from recorder.progress import duration
from sim.errors import SceneError
from sim.fem import Fem
from sim.fem.mesh import meshes_of
from sim.fem.sizing import stages_of
from sim.fem.stepping import path_of
from sim.metrics import Kind, outcome_of, tolerance_of, with_unit
from sim.needed import FINENESS, EffectsPlan, plan_many
from sim.result import Outcome, Result
from sim.scene import Effects, Friction, Gravity, Inertia, Scene, Viscosity
from sim.tiers import simulate_many

# Maximum steps of a motion and elements of a probe's mesh, for scenes that take seconds.
STEPS_MAX, COARSE_MAX = 15, 700
# Default for the maximum number of elements in the meshes that check the plans.
ELEMENTS_MAX = 6000
# Offset of a scene's number, to draw its effects from a separate random stream.
EFFECTS_STREAM = 1_000_000


@dataclass(frozen=True, slots=True)
class Row:
    """Result for one scene."""

    name: str
    found: EffectsPlan
    true: dict[Kind, float] | None
    """Errors of the force (fraction, N) and of markers (px) on the default mesh; None: unsolved."""
    full: float
    """Time of the scene with all effects [s]."""
    less: float
    """Time without the neglected effects [s]."""

    @property
    def value(self) -> float:
        """True error in the unit of the tolerance."""
        assert self.true is not None
        assert self.found.tolerance is not None
        return self.true[self.found.tolerance.kind]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "--scenes", type=int, default=60, metavar="N", help="number of scenes (%(default)s)"
    )
    add_seed(parser, 1)
    parser.add_argument(
        "--tolerance", default="2 %", help='"2 %%", "0.05 N" or "0.5 px" (%(default)s)'
    )
    parser.add_argument(
        "--elements",
        type=int,
        default=ELEMENTS_MAX,
        metavar="N",
        help="maximum number of elements of the meshes that check the plans (%(default)s)",
    )
    parser.add_argument(
        "--device",
        default="cpu",
        help="cpu, one scene at a time; cuda:0 and the like, all scenes in parallel, with mean "
        "times (%(default)s)",
    )
    parser.add_argument(
        "--processes", type=int, default=1, help="parallel processes on a CPU (%(default)s)"
    )


def run(options: argparse.Namespace) -> int:
    """Plan, solve and compare; return 1 if an error exceeds its tolerance.

    Raises:
        SceneError: Invalid tolerance, or unknown device.
    """
    from sim.device import ready_device

    tolerance_of(options.tolerance)
    if options.processes < 1:
        raise SceneError(f"--processes: {options.processes}; allowed: 1 or more")
    ready_device(options.device)
    numerics = Fem(elements_max=options.elements)
    began = time.perf_counter()
    rows: list[Row] = []
    with TemporaryDirectory() as folder, done_counts(print):
        scenes = scenes_of(options.seed, options.scenes, Path(folder))
        batch_size = 1 if options.device == "cpu" else len(scenes)
        parts = [scenes[first : first + batch_size] for first in range(0, len(scenes), batch_size)]
        compare = partial(
            compared, tolerance=options.tolerance, numerics=numerics, device=options.device
        )
        processes = min(options.processes, len(parts))
        for found in side_by_side(compare, parts, options.device, processes):
            for row in found:
                rows.append(row)
                print(line(row), flush=True)
            left = (time.perf_counter() - began) * (len(scenes) / len(rows) - 1)
            print(f"{len(rows)}/{len(scenes)}, {duration(left)} left", file=sys.stderr)
    for text in summary(rows):
        print(text)
    if len(rows) < options.scenes:
        return INTERRUPTED
    return int(any(row.true is not None and row.value > _limit(row) for row in rows))


def scenes_of(seed: int, count: int, folder: Path) -> list[tuple[str, Scene]]:
    """Return sensible scenes of `drawn`, with two or more effects drawn again, some weak."""
    found: list[tuple[str, Scene]] = []
    index = 0
    while len(found) < count:
        one = drawn(seed, index, folder)
        if one.scene is not None and one.what.startswith("sensible"):
            scene = replace(one.scene, effects=_effects(Dice(seed, EFFECTS_STREAM + index)))
            if _steps(scene) <= STEPS_MAX and _elements(scene) <= COARSE_MAX:
                found.append((one.name, scene))
        index += 1
    return found


def _effects(dice: Dice) -> Effects:
    """Return two to four effects, each weak as often as strong."""
    while True:
        branches = dice.whole(1, 2)
        effects = Effects(
            Friction(dice.scaled(1e-3, 1.0)) if dice.chance(0.6) else None,
            Viscosity(
                tuple(dice.scaled(1e-3, 1.0) for _ in range(branches)),
                tuple(dice.scaled(1e-4, 10.0) for _ in range(branches)),
            )
            if dice.chance(0.5)
            else None,
            Inertia(dice.one_of([1.0, 1.0, 100.0])) if dice.chance(0.6) else None,
            Gravity(dice.one_of([(0.0, 0.0, -9.81), (0.0, 0.0, 9.81), (9.81, 0.0, 0.0)]))
            if dice.chance(0.6)
            else None,
        )
        if len(effects.key) >= 2:
            return effects


def _steps(scene: Scene) -> int:
    """Return the number of steps of the motion, without rejected ones."""
    path = path_of(scene, Fem())
    total = 0
    for segment in range(1, len(scene.motion)):
        path.segment = segment
        total += round(1 / path.limit)
    return total


def _elements(scene: Scene) -> int:
    """Return the number of elements of a probe's mesh, as planned before it is solved."""
    sizes = [stage.sizes for stage in stages_of(scene)]
    numerics = Fem(fineness=FINENESS)
    return sum(len(one.elements) for one in meshes_of([scene] * len(sizes), numerics, sizes))


def compared(
    scenes: Sequence[tuple[str, Scene]], tolerance: str, numerics: Fem, device: str
) -> list[Row]:
    """Return the plans of scenes, compared with both solutions if any effect is neglected."""
    plain = [scene for _name, scene in scenes]
    plans = plan_many(plain, tolerance=tolerance, device=device)
    lesser = [i for i, one in enumerate(plans) if one.omitted]
    full, full_time = _solved([plain[i] for i in lesser], numerics, device)
    less, less_time = _solved([plans[i].needed for i in lesser], numerics, device)
    rows = []
    for i, ((name, scene), one) in enumerate(zip(scenes, plans, strict=True)):
        if i not in lesser:
            rows.append(Row(name, one, {"fraction": 0.0, "force": 0.0, "marker": 0.0}, 0.0, 0.0))
            continue
        both = full[lesser.index(i)], less[lesser.index(i)]
        true = None
        if isinstance(both[0], Result) and isinstance(both[1], Result):
            true = worst_errors(outcome_of(both[1]), outcome_of(both[0]), scene.body)
        rows.append(Row(name, one, true, full_time, less_time))
    return rows


def _solved(scenes: Sequence[Scene], numerics: Fem, device: str) -> tuple[list[Outcome], float]:
    """Return the outcomes and their mean time [s]."""
    began = time.perf_counter()
    outcomes = simulate_many(scenes, numerics, device=device)
    return outcomes, (time.perf_counter() - began) / max(len(scenes), 1)


def line(row: Row) -> str:
    """Return a scene's effects, neglected effects, errors and time as a line."""
    found = row.found
    assert found.tolerance is not None
    text = f"{row.name}: {' '.join(found.scene.effects.key)}; left out: "
    if not found.omitted:
        return f"{text}nothing; probes {found.seconds:.1f} s"
    joint = found.joint
    text += f"{' '.join(found.omitted)} ({found.joint_by}); stated "
    text += with_unit("fraction", joint.value("fraction"))
    text += f" {with_unit('marker', joint.marker)}"
    if row.true is None:
        return f"{text}; no solution on the default mesh"
    kept = "" if row.value <= joint.value(found.tolerance.kind) else " MORE THAN STATED"
    true = (
        f"{with_unit('fraction', row.true['fraction'])} {with_unit('marker', row.true['marker'])}"
    )
    saved = f"{row.full:.1f} - {row.less:.1f} = {row.full - row.less:.1f} s saved"
    return f"{text}, true {true}{kept}; {saved}, probes {found.seconds:.1f} s"


def summary(rows: Sequence[Row]) -> list[str]:
    """Return counts of scenes within the tolerance and the stated error, and times."""
    some = [row for row in rows if row.found.omitted and row.true is not None]
    within = sum(row.value <= _limit(row) for row in some)
    kept = sum(row.value <= row.found.joint.value(_kind(row)) for row in some)
    saved, full = sum(row.full - row.less for row in some), sum(row.full for row in some)
    spent = sum(row.found.seconds for row in rows)
    lost = sum(row.true is None for row in rows)
    return [
        f"{len(rows)} scenes, effects left out in {len(some) + lost}, {lost} of them without a "
        "solution",
        f"{within} of {len(some)} within the tolerance, {kept} within the stated error",
        f"{saved:.1f} s of {full:.1f} s saved where effects were left out, {spent:.1f} s spent on "
        "all probes",
    ]


def _kind(row: Row) -> str:
    assert row.found.tolerance is not None
    return row.found.tolerance.kind


def _limit(row: Row) -> float:
    assert row.found.tolerance is not None
    return row.found.tolerance.value
