"""Plan of an archive of simulated sensors: one frozen value, stored in the archive."""

import functools
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal, get_args

from sim.arrays import Progress
from sim.errors import PassesThrough, SceneError, SimulationDiverged, check_choice, check_range
from sim.fem import FOR_EDGES, Fem, Grading, further_settings
from sim.indenters import NAMES, drawn_name, indenter_of, is_indenter, number_of
from sim.layer import Layer
from sim.paper_presses import DEPTHS_MM, PLACES_MM
from sim.planning import plan as within
from sim.result import ContactTier, Outcome, Result
from sim.scene import Body, Motion, Scene, from_target, press, through
from sim.sensors import CameraSignal, SimulatedSensor, sensor
from sim.tiers import simulate_many
from trajectories import PHASES, ForceDepth, Point, PressShear, Target

# A press that is simulated once, and those of its frames that become rows of an archive.

NO_PHASE = -1
NO_LOCATION = -1


@dataclass(frozen=True, slots=True)
class PressRecording:
    """Frames of one target: rows of an archive that are compressed together."""

    target: int
    """Number of the target within the indenter, as in the whole plan."""
    number: int
    """Number among all recordings that the sensor could have; seeds a frame's random draws."""
    session_point: int
    """Number of the contact point in the sensor's session."""
    frames: tuple[int, ...]
    """Frames of the press's motion."""
    phases: tuple[int, ...]
    """Code of each frame's phase, or -1."""
    locations: tuple[int, ...]
    """Location of each frame, or -1."""

    def __len__(self) -> int:
        return len(self.frames)


@dataclass(frozen=True, slots=True)
class PlannedPress:
    """One indenter on one motion, as commanded to the robot."""

    indenter: str
    motion: Motion
    recordings: tuple[PressRecording, ...]
    """Recordings of equal length."""


# Solving the presses of an archive, with other settings where the first find no solution.

# Default for the largest element [m]: indenters' edges need it on a thick body.
SPACING_MAX = 1.2e-3


@dataclass(frozen=True, slots=True)
class Solving:
    """Tier and mesh, or an accepted error in place of both.

    Raises:
        SceneError: A value is out of range, or settings exclude each other.
    """

    tier: ContactTier = "fem"
    spacing: float | None = None
    """Height of an element [m]; None: the thickness over `cells`, but 1.2 mm at most."""
    cells: int = 5
    """Elements over the thickness, without a spacing: 0.8 mm in the paper's gel."""
    for_edges: bool = True
    """True if elements are narrower around the indenter (`sim.fem.FOR_EDGES`)."""
    one_topology: bool = False
    """True if all meshes of one call have the same topology, for one launch on a GPU."""
    tolerance: str | None = None
    """Accepted error such as "3 %"; each press gets the meshes that it needs (`sim.tolerance`)."""

    def __post_init__(self) -> None:
        check_choice("solving.tier", self.tier, get_args(ContactTier))
        if self.spacing is not None:
            check_range("solving", "spacing", self.spacing, 0.0, 1.0, unit="m", open_low=True)
            if self.tier == "layer" or self.tolerance is not None:
                conflict = "tier layer" if self.tolerance is None else "a tolerance"
                raise SceneError(
                    f"solving.spacing: {self.spacing!r} m with {conflict}; allowed: None"
                )
        check_range("solving", "cells", self.cells, 1, 1000)
        if self.tolerance is not None:
            if self.tier != "fem":
                raise SceneError(f"solving.tier: {self.tier!r} with a tolerance; allowed: none")
            from sim.metrics import tolerance_of

            tolerance_of(self.tolerance)

    def settings(self, body: Body) -> Layer | Fem:
        """Return the tier for a body, with its settings."""
        if self.tier == "layer":
            return Layer()
        spacing = self.spacing
        if spacing is None:
            spacing = min(body.thickness / self.cells, SPACING_MAX)
        return Fem(
            spacing=spacing,
            grading=FOR_EDGES if self.for_edges else Grading(),
            one_topology=self.one_topology,
        )


@dataclass(frozen=True, slots=True)
class Solved:
    """Outcome of one press."""

    result: Result | None
    """Result, or None if no attempt found a solution."""
    how: dict[str, Any]
    """Provenance as plain values without times; stored with each frame."""


def solve(
    scenes: Sequence[Scene],
    solving: Solving,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
) -> list[Solved]:
    """Solve scenes of bodies of equal thickness, and retry failed ones with other settings."""
    if solving.tolerance is not None:
        return [_within(scene, solving.tolerance, device) for scene in scenes]
    first = solving.settings(scenes[0].body)
    outcomes = simulate_many(scenes, first, device=device, progress=progress)
    ways = ["as asked for"] * len(scenes)
    failed: list[list[str]] = [[] for _scene in scenes]
    further = [] if isinstance(first, Layer) else further_settings(first, scenes[0].body)
    for words, fem, finer in further:
        again = [
            (i, one)
            for i, one in enumerate(outcomes)
            if isinstance(one, SimulationDiverged) and isinstance(one, PassesThrough) == finer
        ]
        # In one call: a GPU solves a few presses in the time of one.
        some = simulate_many([scenes[i] for i, _ in again], fem, device=device)
        for (i, diverged), outcome in zip(again, some, strict=True):
            failed[i].append(_reason(ways[i], diverged))
            outcomes[i], ways[i] = outcome, words
    return [
        _solved(outcome, solving, device, way, attempts)
        for outcome, way, attempts in zip(outcomes, ways, failed, strict=True)
    ]


def _solved(
    outcome: Outcome, solving: Solving, device: str, way: str, failed: Sequence[str]
) -> Solved:
    """Return an outcome with its provenance: the way it was solved, and attempts that failed."""
    if isinstance(outcome, Result):
        how = _how(outcome)
        return Solved(outcome, {**how, "again": way, "failed": [*failed]} if failed else how)
    failed = [*failed, _reason(way, outcome)]
    return Solved(None, {"tier": solving.tier, "device": device, "failed": failed})


def _within(scene: Scene, tolerance: str, device: str) -> Solved:
    """Solve on finer and finer meshes until the error is within the tolerance."""
    try:
        # Images show the skin, whose error 'layer' does not estimate.
        result = within(scene, tolerance, only="fem", device=device).run()
    except SimulationDiverged as diverged:
        failed = [_reason(f"within {tolerance}", diverged)]
        return Solved(None, {"tolerance": tolerance, "device": device, "failed": failed})
    how = {**_how(result), "tolerance": tolerance}
    tried = result.record["plan"]["tried"]
    return Solved(result, {**how, "failed": [_one_line(line) for line in tried]} if tried else how)


def _how(result: Result) -> dict[str, Any]:
    record = result.record
    how: dict[str, Any] = {
        "tier": result.tier,
        "mesh": record["mesh"].get("cells") or record["mesh"].get("grid"),
        "precision": record["precision"],
        "device": record["device"],
    }
    if result.tier == "layer":
        how["small strain"] = True
    return how


def _reason(attempt: str, diverged: SimulationDiverged) -> str:
    diverged.forget_dump()  # the provenance is sufficient; dumps would fill the disk
    return f"{attempt}: {_one_line(str(diverged))}"


def _one_line(text: str) -> str:
    """Return a message as one line, without the path of a dump, which differs between runs."""
    return " ".join(text.split("state:")[0].split()).rstrip(" ;,.")


@functools.cache
def described(solving: Solving, body: Body) -> str:
    """Return a short description of how presses on a body are solved."""
    if solving.tolerance is not None:
        return f"within {solving.tolerance}"
    settings = solving.settings(body)
    if isinstance(settings, Layer):
        return "layer (small strain)"
    shape = "for edges" if solving.for_edges else "even"
    return f"fem, elements {1e3 * (settings.spacing or 0):.3g} mm high, graded {shape}"


Part = Literal["states", "targets"]

# Held-out indenters: the paper's models are tested but never trained on them.
UNSEEN = ("sphere_s", "triangle", "pacman", "cone", "wave", "torus")
STEPS_MAX = 1000
# Most presses that are solved and written together: the nine places of the paper's states.
UNIT_PRESSES = 9


@dataclass(frozen=True, slots=True)
class DatasetPlan:
    """Plan that determines every byte of an archive on one kind of machine.

    Raises:
        SceneError: A value is out of range.
    """

    work: Part
    """`states`: presses at nine places to five depths; `targets`: the sensors' recorded presses."""
    sensors: tuple[SimulatedSensor, ...]
    """Rows of `sim.sensors`, with different names."""
    indenters: tuple[str, ...] = NAMES
    """Names, in the order of `sim.indenters.NAMES`, then of drawn ones, such as drawn-0."""
    solving: Solving = field(default_factory=Solving)
    """Tier and mesh, or tolerance, of the presses."""
    seed: int = 0
    steps: int = 10
    """Frames per phase of a target; states have no phases."""
    fraction: float = 1.0
    """Fraction of the targets to use, spread evenly over points, depths and directions."""
    unit_presses: int = UNIT_PRESSES
    """Most presses of one indenter whose frames share a file."""
    batch_size: int = UNIT_PRESSES
    """Most presses solved in one call, rounded to whole files; a GPU needs many."""

    def __post_init__(self) -> None:
        check_choice("plan.work", self.work, get_args(Part))
        _check_names("sensors", [each.name for each in self.sensors])
        _check_names("indenters", list(self.indenters))
        if unknown := [name for name in self.indenters if not is_indenter(name)]:
            raise SceneError(f"plan.indenters: {unknown}; allowed: {', '.join(NAMES)}, drawn-0 ...")
        if self.indenters != tuple(sorted(self.indenters, key=code)):
            raise SceneError(
                f"plan.indenters: {self.indenters}; allowed: in the order of {NAMES}, then of the "
                "numbers of drawn ones"
            )
        check_range("plan", "seed", self.seed, 0, 2**32)
        check_range("plan", "steps", self.steps, 1, STEPS_MAX)
        check_range("plan", "fraction", self.fraction, 0.0, 1.0, open_low=True)
        check_range("plan", "unit_presses", self.unit_presses, 1, 10_000)
        check_range("plan", "batch_size", self.batch_size, 1, 100_000)
        for each in self.sensors:
            if self.work == "targets" and each.trajectory is None:
                raise SceneError(f"{each.name}.trajectory: None; allowed: a sensor that has one")
            if self.work == "states" and not isinstance(each.signal, CameraSignal):
                raise SceneError(f"{each.name}.signal: taxels; allowed for states: a camera")
        _check_names(
            "names in the archive", [name for each in self.sensors for name in names(each)]
        )


def names(sensor: SimulatedSensor) -> tuple[str, ...]:
    """Return a sensor's names in an archive: its patterns, if only they identify its data."""
    signal = sensor.signal
    simulated = sensor.trajectory is None
    if isinstance(signal, CameraSignal) and (simulated or len(signal.patterns) > 1):
        return signal.patterns
    return (sensor.name,)


def code(indenter: str) -> int:
    """Return the code of an indenter, the same in archives with all or some indenters."""
    return NAMES.index(indenter) if indenter in NAMES else len(NAMES) + number_of(indenter)


def indenter_names(plan: DatasetPlan) -> tuple[str, ...]:
    """Return the names of all codes of a plan's archive: the 18, then drawn ones."""
    drawn = max(0, code(plan.indenters[-1]) + 1 - len(NAMES))
    return (*NAMES, *map(drawn_name, range(drawn)))


def _check_names(what: str, listed: list[str]) -> None:
    if not listed or len(set(listed)) != len(listed):
        raise SceneError(f"plan.{what}: {listed}; allowed: one or more, all different")


# The real trajectories: press, shear, shear back, release; and the force-depth presses.
#
# A target is one press of `4 steps + 1` frames: p0, clear of the surface, then `steps` frames of
# each phase. The force-depth presses come last: one path that goes down and up `repeats` times.
# Each repeat is a target numbered after the others, of the same length, without a location.

# Indenter of the paper's force-depth presses.
FORCE_DEPTH_INDENTER = "prism"


def target_presses(plan: DatasetPlan, each: SimulatedSensor) -> tuple[PlannedPress, ...]:
    """Return a sensor's presses: the chosen targets by indenter, then the force-depth presses."""
    if each.trajectory is None:
        raise SceneError(f"{each.name}.trajectory: None; allowed: a sensor that has one")
    targets = chosen_targets(each.trajectory, plan.fraction)
    presses = [
        _target_press(plan, each, each.trajectory, indenter, target)
        for indenter in plan.indenters
        for target in targets
    ]
    if each.force_depth is not None:
        presses.append(_force_depth(plan, each, each.trajectory, each.force_depth))
    return tuple(presses)


def chosen_targets(trajectory: PressShear, fraction: float) -> tuple[Target, ...]:
    """Return a fraction of the targets, at least one, spread over points, depths and directions.

    Greedily picks the target whose point, depth, direction and pairs of them have occurred least
    often so far, so that a smaller fraction is a subset of a larger one.
    """
    targets = list(trajectory.targets())
    count = max(1, round(fraction * len(targets)))
    if count == len(targets):
        return tuple(targets)
    met: Counter[tuple[object, ...]] = Counter()
    chosen: list[Target] = []
    rest = targets

    def seldom(target: Target) -> tuple[int, int, int]:
        often = [met[trait] for trait in _traits(target)]
        return sum(often[:3]), sum(often[3:]), target.index  # singles, then pairs

    while len(chosen) < count:
        best = min(rest, key=seldom)
        chosen.append(best)
        rest = [one for one in rest if one is not best]
        met.update(_traits(best))
    return tuple(sorted(chosen, key=lambda one: one.index))


def _traits(target: Target) -> tuple[tuple[object, ...], ...]:
    point, depth, direction = target.point, target.depth, target.direction
    singles = (("point", point), ("depth", depth), ("direction", direction))
    return (*singles, *((*a, *b) for a, b in pairwise((*singles, singles[0]))))


def _target_press(
    plan: DatasetPlan, each: SimulatedSensor, trajectory: PressShear, indenter: str, target: Target
) -> PlannedPress:
    count = 4 * plan.steps + 1
    phases = (0, *(phase for phase in range(len(PHASES)) for _ in range(plan.steps)))
    location = code(indenter) * len(trajectory) + target.index
    recording = PressRecording(
        target=target.index,
        number=_number(each, trajectory, indenter, target.index),
        session_point=_session_point(trajectory, indenter, target.point),
        frames=tuple(range(count)),
        phases=phases,
        locations=(location,) * count,
    )
    motion = _motion(trajectory, target, plan.steps, each.speed)
    return PlannedPress(indenter, motion, (recording,))


@functools.lru_cache(maxsize=4096)
def _motion(trajectory: PressShear, target: Target, steps: int, speed: float) -> Motion:
    """Return the motion of a target, cached: all indenters and most sensors of a group share it.

    A body that is pressed as if it had a dome is flat: its top follows the dome from point to
    point, so the tip's heights are those above the top at the point.
    """
    drop = trajectory.height(*target.origin[:2])
    origin, bottom, sheared = (
        (x, y, z - drop) for x, y, z in (target.origin, target.bottom, target.sheared)
    )
    flat = replace(target, origin=origin, bottom=bottom, sheared=sheared)
    return from_target(trajectory, flat, steps=steps, speed=speed)


def _force_depth(
    plan: DatasetPlan, each: SimulatedSensor, trajectory: PressShear, spec: ForceDepth
) -> PlannedPress:
    """Return the force-depth press: repeated loading and unloading, `2 steps` frames each."""
    half = 2 * plan.steps
    waypoints: list[Point] = [next(spec.targets()).origin]
    recordings = []
    for target in spec.targets():
        first = len(waypoints) - 1
        for move in spec.moves(target):
            waypoints += _along(move.start, move.end, half)
        recordings.append(
            PressRecording(
                target=len(trajectory) + target.index,
                number=_number(
                    each, trajectory, FORCE_DEPTH_INDENTER, len(trajectory) + target.index
                ),
                session_point=_session_point(trajectory, FORCE_DEPTH_INDENTER, target.point),
                frames=tuple(range(first, first + 2 * half + 1)),
                phases=(
                    *(PHASES.index("normal_inc"),) * (half + 1),
                    *(PHASES.index("normal_dec"),) * half,
                ),
                locations=(NO_LOCATION,) * (2 * half + 1),
            )
        )
    return PlannedPress(
        FORCE_DEPTH_INDENTER, through(waypoints, speed=each.speed), tuple(recordings)
    )


def _along(start: Point, end: Point, steps: int) -> list[Point]:
    """Return `steps` evenly spaced points after `start`, up to and including `end`."""
    points: list[Point] = []
    for index in range(1, steps + 1):
        x, y, z = (a + (b - a) * index / steps for a, b in zip(start, end, strict=True))
        points.append((x, y, z))
    return points


def _number(each: SimulatedSensor, trajectory: PressShear, indenter: str, target: int) -> int:
    repeats = 0 if each.force_depth is None else each.force_depth.repeats
    return code(indenter) * (len(trajectory) + repeats) + target


def _session_point(trajectory: PressShear, indenter: str, point: int) -> int:
    """Return a contact point's number in the lab's order: by indenter, then by point."""
    points = trajectory.points
    index = points.index(point) if point in points else 0
    return code(indenter) * len(points) + index


# The paper's simulated states: 18 indenters, 9 places, 5 depths, each with its own location.

# Places of the presses, x and y [mm]; a target is the index of a place.
PLACES = tuple((x, y) for x in PLACES_MM for y in PLACES_MM)
# Number of states of one indenter.
STATES = len(PLACES) * len(DEPTHS_MM)


def gel(patterns: tuple[str, ...] | None = None) -> SimulatedSensor:
    """Return the paper's gel with some of its patterns, or all 12.

    Raises:
        SceneError: A pattern is unknown.
    """
    each = sensor("gel")
    if patterns is None or not isinstance(each.signal, CameraSignal):
        return each
    return replace(each, signal=replace(each.signal, patterns=patterns))


def state_presses(plan: DatasetPlan, each: SimulatedSensor) -> tuple[PlannedPress, ...]:
    """Return a sensor's presses by indenter, one per place, each to all depths."""
    return tuple(
        _state_press(each, indenter, target)
        for indenter in plan.indenters
        for target in range(len(PLACES))
    )


def _state_press(each: SimulatedSensor, indenter: str, target: int) -> PlannedPress:
    x, y = PLACES[target]
    motion = press([depth / 1e3 for depth in DEPTHS_MM], at=(x / 1e3, y / 1e3), speed=each.speed)
    count = len(DEPTHS_MM)
    number = code(indenter) * len(PLACES) + target
    recording = PressRecording(
        target=target,
        number=number,
        session_point=0,
        # The first frame of the motion only touches.
        frames=tuple(range(1, count + 1)),
        phases=(NO_PHASE,) * count,
        locations=tuple(number * count + depth for depth in range(count)),
    )
    return PlannedPress(indenter, motion, (recording,))


# Families of sensors that share deformations, and the division of the work into units.

# Modulus to simulate where forces are proportional to the modulus [Pa].
MODULUS = Body().modulus


@dataclass(frozen=True, slots=True)
class Family:
    """Sensors that share their deformations: they differ only in readout or in modulus.

    Without mass and weight, a layer that is twice as stiff deforms equally under the same motion,
    with twice the force: friction, contact and the viscous branches are ratios.
    """

    sensors: tuple[SimulatedSensor, ...]
    presses: tuple[PlannedPress, ...]
    unit_presses: int
    """Number of recordings in a unit of files."""

    @property
    def rows_each(self) -> int:
        """Number of rows per recording."""
        return len(self.presses[0].recordings[0])

    @property
    def recordings(self) -> int:
        """Number of recordings per sensor."""
        return sum(len(press.recordings) for press in self.presses)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its sensors in the archive, one per pattern where there are several."""
        return tuple(name for each in self.sensors for name in names(each))


@dataclass(frozen=True, slots=True)
class Unit:
    """Presses that are solved in one call and written as whole files."""

    number: int
    """Position in the plan."""
    family: int
    first: int
    """Index of the first press in the family."""
    last: int
    """Index after the last press."""
    files: range
    """File units of the archive that it writes, for every sensor of the family."""


@functools.cache
def families(plan: DatasetPlan) -> tuple[Family, ...]:
    """Return the sensors of a plan grouped by shared deformations, in order."""
    by_deformation: dict[Hashable, list[SimulatedSensor]] = {}
    for each in plan.sensors:
        by_deformation.setdefault(_deformation(plan, each), []).append(each)
    return tuple(_family(plan, tuple(sensors)) for sensors in by_deformation.values())


@functools.cache
def units(plan: DatasetPlan) -> tuple[Unit, ...]:
    """Return all units of a plan; they depend on the plan alone, not on finished work."""
    cut: list[Unit] = []
    for index, family in enumerate(families(plan)):
        step = max(1, plan.batch_size // family.unit_presses) * family.unit_presses
        single = [press for press in family.presses if len(press.recordings) == 1]
        for first in range(0, len(single), step):
            last = min(first + step, len(single))
            files = range(first // family.unit_presses, -(-last // family.unit_presses))
            cut.append(Unit(len(cut), index, first, last, files))
        if len(single) < len(family.presses):
            # Presses with several recordings come last, after whole units of the others.
            files = range(
                len(single) // family.unit_presses, -(-family.recordings // family.unit_presses)
            )
            cut.append(Unit(len(cut), index, len(single), len(family.presses), files))
    return tuple(cut)


def scenes(plan: DatasetPlan, family: Family, presses: tuple[PlannedPress, ...]) -> list[Scene]:
    """Return the scenes to simulate, for the mount of the first sensor and the common modulus."""
    lead = family.sensors[0]
    placed = [
        lead.placed(indenter_of(press.indenter), press.motion, seed=plan.seed) for press in presses
    ]
    if not _proportional(plan, lead):
        return placed
    body = replace(lead.body, modulus=MODULUS)
    return [replace(scene, body=body) for scene in placed]


def force_scale(plan: DatasetPlan, sensor: SimulatedSensor) -> float:
    """Return the factor from forces in a family's scenes to those of one of its sensors."""
    return sensor.body.modulus / MODULUS if _proportional(plan, sensor) else 1.0


def _family(plan: DatasetPlan, sensors: tuple[SimulatedSensor, ...]) -> Family:
    presses = (state_presses if plan.work == "states" else target_presses)(plan, sensors[0])
    of_one = sum(
        press.indenter == plan.indenters[0] and len(press.recordings) == 1 for press in presses
    )
    # A unit holds presses of one indenter, in a size that divides them, so that all are full.
    size = max(n for n in range(1, plan.unit_presses + 1) if of_one % n == 0)
    return Family(sensors, presses, size)


def _deformation(plan: DatasetPlan, each: SimulatedSensor) -> Hashable:
    """Return a key that is equal for sensors with the same deformations."""
    body = replace(each.body, modulus=MODULUS) if _proportional(plan, each) else each.body
    varied = each.variation.mount, each.variation.grip
    own = each.name if any(varied) else ""
    return body, each.effects, each.film, each.speed, each.trajectory, each.force_depth, varied, own


def _proportional(plan: DatasetPlan, each: SimulatedSensor) -> bool:
    """Return True if forces may be scaled with the modulus; not with a tolerance in newtons."""
    massless = each.effects.inertia is None and each.effects.gravity is None
    tolerance = plan.solving.tolerance
    return massless and (tolerance is None or not tolerance.strip().endswith("N"))
