"""Comparison of `sim` with the reference solutions of this folder, force by force."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from benchmarks.independent import foreign, foreign_cases
from benchmarks.independent.cases import CASES, MM, Case
from benchmarks.independent.foreign_cases import ForeignCase
from benchmarks.independent.truth import load
from benchmarks.processes import side_by_side
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import (
    Indenter,
    bar,
    box,
    extruded,
    flat_punch,
    rounded_cone,
    sphere,
    torus,
    tube,
)
from sim.indenters.outline import Part
from sim.planning import plan
from sim.scene import Body, Effects, Friction, Scene, press, through
from sim.tiers import simulate

if TYPE_CHECKING:
    from sim.tiers import Tier


# Error that counts as good [%].
WITHIN = 3.0


@dataclass(frozen=True)
class Settings:
    """Settings of `sim`; a tolerance is in place of the tier."""

    tier: Tier = Fem()
    tolerance: str | None = None
    device: str = "cpu"


@dataclass(frozen=True)
class Task:
    """A scene of `sim` and the reference forces of some of its frames."""

    name: str
    scene: Scene
    frames: tuple[int, ...]
    """Frames of the result that have a reference force."""
    truths: tuple[tuple[float, float, float], ...]
    """Force on the body [N]; NaN for unknown components."""
    errors: tuple[float, ...]
    """Uncertainties of the reference forces [%]."""


@dataclass(frozen=True)
class Row:
    """Comparison of one force."""

    case: str
    depth_mm: float
    truth_n: float
    """Magnitude of the force, over the known components."""
    ours_n: float
    """The same of `sim`; NaN if it was not solved."""
    error_percent: float
    """|ours - truth| as vectors over |truth|; signed if only one component is known."""
    truth_error_percent: float
    own_percent: float
    """Error estimate of the result; NaN without one."""
    seconds: float
    """Wall time of the whole press."""
    reported: str = ""
    """Reason why it was not solved."""


def scene_of(case: Case) -> Scene:
    """Return the case as a scene of `sim`."""
    measures = [measure * MM for measure in case.measures]
    indenter: Indenter
    match case.kind:
        case "sphere":
            indenter = sphere(*measures)
        case "punch":
            indenter = flat_punch(*measures)
        case "cone":
            indenter = rounded_cone(math.radians(case.measures[0]), measures[1])
        case "torus":
            indenter = torus(*measures)
        case "tube":
            indenter = tube(*measures)
    body = Body(case.size * MM, case.size * MM, case.thickness * MM, case.modulus, case.poisson)
    effects = Effects(friction=Friction(case.friction)) if case.friction else Effects()
    return Scene(indenter, press([depth * MM for depth in case.depths]), body, effects)


def round_tasks(only: Sequence[str] = ()) -> list[Task]:
    """Return the cases of `axisymmetric.csv` whose name has one of the words; all without words."""
    rows = load()
    tasks = []
    for case in CASES:
        mine = [row for row in rows if row.case == case.name]
        if not mine or (only and not any(word in case.name for word in only)):
            continue
        tasks.append(
            Task(
                case.name,
                scene_of(case),
                tuple(range(1, len(mine) + 1)),
                tuple((math.nan, math.nan, -row.force_n) for row in mine),
                tuple(row.error_percent for row in mine),
            )
        )
    return tasks


def foreign_scene(case: ForeignCase) -> Scene:
    """Return the case as a scene of `sim`."""
    measures = [measure * MM for measure in case.measures]
    indenter: Indenter
    match case.shape:
        case "spheres":
            radius = measures[0]
            each = [
                Part("turned", "circle", (0.0, radius, radius), "union", axis=(middle, 0.0))
                for middle in measures[1:] or (0.0,)
            ]
            indenter = Indenter("spheres", tuple(each))
        case "punch":
            indenter = flat_punch(*measures)
        case "bar":
            indenter = bar(*measures)
        case "box":
            indenter = box(*measures)
        case "triangle":
            corners = [(*measures[index : index + 2], 0.0) for index in (0, 2, 4)]
            indenter = extruded([value for corner in corners for value in corner], measures[-1])
    if any(case.tilt):
        indenter = indenter.tilted(*map(math.radians, case.tilt))
    dome = case.dome * MM if case.dome else None
    size_x, size_y, thickness = (length * MM for length in case.size)
    body = Body(size_x, size_y, thickness, case.modulus, case.poisson, dome)
    effects = Effects(friction=Friction(case.friction)) if case.friction else Effects()
    x, y, _ = case.path[0]
    points = [(x * MM, y * MM, 0.0)] + [(x * MM, y * MM, -z * MM) for x, y, z in case.path]
    return Scene(indenter, through(points, speed=10e-3), body, effects)


def foreign_tasks(only: Sequence[str] = ()) -> list[Task]:
    """Return the cases of `foreign.csv` whose name has one of the words; all without words."""
    rows = foreign.load()
    tasks = []
    for case in foreign_cases.CASES:
        mine = [row for row in rows if row.case == case.name]
        if not mine or (only and not any(word in case.name for word in only)):
            continue
        tasks.append(
            Task(
                case.name,
                foreign_scene(case),
                tuple(row.point + 1 for row in mine),
                tuple((row.force_x_n, row.force_y_n, row.force_z_n) for row in mine),
                tuple(row.error_percent for row in mine),
            )
        )
    return tasks


def compared(task: Task, settings: Settings) -> list[Row]:
    """Solve a task and compare; rows of a scene that `sim` cannot solve state the reason."""
    from time import perf_counter

    start = perf_counter()
    reported, own = "", math.nan
    forces = [(math.nan, math.nan, math.nan)] * len(task.frames)
    try:
        if settings.tolerance is not None:
            result = plan(task.scene, settings.tolerance, device=settings.device).run()
        else:
            result = simulate(task.scene, settings.tier, device=settings.device)
        forces = [tuple(result.force[frame]) for frame in task.frames]
        own = own_error(result.record)
    except (SceneError, SimulationDiverged) as error:
        reported = str(error)
    seconds = perf_counter() - start
    rows = []
    for frame, force, truth, truth_error in zip(
        task.frames, forces, task.truths, task.errors, strict=True
    ):
        known = [index for index in range(3) if not math.isnan(truth[index])]
        right = math.hypot(*(truth[index] for index in known))
        ours = math.hypot(*(force[index] for index in known))
        off = math.hypot(*(force[index] - truth[index] for index in known)) / right
        if len(known) == 1:
            off = ours / right - 1
        depth = -task.scene.motion.tip[frame][2] / MM
        rows.append(
            Row(task.name, depth, right, ours, 100 * off, truth_error, own, seconds, reported)
        )
    return rows


def own_error(record: dict[str, object]) -> float:
    """Return the error estimate of a result's force [%], or NaN without one.

    `record["error"]` may be a fraction, or a mapping with `force` or `percent`.
    """
    reported = record.get("error")
    if isinstance(reported, dict):
        if isinstance(reported.get("percent"), int | float):
            return float(reported["percent"])
        reported = reported.get("force", reported.get("relative"))
    if isinstance(reported, Sequence) and not isinstance(reported, str) and len(reported):
        reported = max(reported)
    return 100 * float(reported) if isinstance(reported, int | float) else math.nan


def all_compared(tasks: Sequence[Task], settings: Settings, processes: int) -> Iterator[list[Row]]:
    """Yield the rows of each task as it completes; in the order of the tasks with one process.

    Raises:
        WorkerLost: A worker process was killed.
    """
    from sim.device import ready_device

    ready_device(settings.device)
    compare = partial(compared, settings=settings)
    yield from side_by_side(compare, tasks, settings.device, processes)


def summary(rows: Sequence[Row]) -> str:
    """Return the number of forces, the worst error, and the number of good forces."""
    solved = [row for row in rows if not math.isnan(row.error_percent)]
    cases = len({row.case for row in rows})
    missing = len(rows) - len(solved)
    if not solved:
        return f"{cases} cases, {len(rows)} forces: none solved"
    worst = max(solved, key=lambda row: abs(row.error_percent))
    # A reference force is only known to its own uncertainty.
    good = sum(abs(row.error_percent) <= WITHIN + row.truth_error_percent for row in solved)
    lost = f", {missing} not solved" if missing else ""
    return (
        f"{cases} cases, {len(rows)} forces{lost}; within {WITHIN:g} %: {good}; worst "
        f"{worst.error_percent:+.1f} % ({worst.case} at {worst.depth_mm:g} mm)"
    )


HEAD = f"{'case':<44} {'depth mm':>8} {'truth N':>10} {'ours N':>10} {'error %':>8} {'own %':>7}"


def line(row: Row) -> str:
    """Return a row as a line of the table."""
    if row.reported:
        return f"{row.case:<44} {row.depth_mm:8.4g} {row.truth_n:10.4g} not solved: {row.reported}"
    own = "" if math.isnan(row.own_percent) else f"{row.own_percent:7.2f}"
    return (
        f"{row.case:<44} {row.depth_mm:8.4g} {row.truth_n:10.4g} {row.ours_n:10.4g} "
        f"{row.error_percent:+8.2f} {own:>7}"
    )
