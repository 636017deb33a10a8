"""Only the effects a scene calls for: what each one changes, found on coarse meshes.

A probe is the scene on a coarse `fem` mesh with some of its effects left out. Its difference from
the probe with all of them is what they are worth: both have the same mesh, whose own error mostly
cancels. Where dimensions show that an effect is far below what matters (`sim.effect_bounds`), no
probe is spent on it. Effects are left out in the order of their worth, as many as a probe without
all of them together allows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sim.effect_bounds import Change, bounds_of, no_change
from sim.errors import SceneError, check_kind
from sim.metrics import (
    Kind,
    Tolerance,
    force_errors,
    marker_errors,
    outcome_of,
    tolerance_of,
    with_unit,
)
from sim.result import Outcome, Result, to_json
from sim.scene import Scene
from sim.tiers import part_of, simulate_many
from sim.tolerance import FLOOR, simulate_within

Progress = Callable[[float], None]

# Share of a tolerance that effects left out may take; what they do not take is the mesh's.
PART = 1 / 3
# Error of leaving effects out on a finer mesh over that of the probes, at most: up to 1.34 in 22
# random scenes, but for one whose error was below `NOISE` (`python -m benchmarks needed`).
SAFETY = 1.5
# Least error of a force, over the force, that probes tell of leaving effects out: states are found
# along other steps, with what is left of the penetration.
NOISE = 5e-4
# Share of that part which a bound must be below for an effect to be spared a probe.
BOUND_PART = 0.1
# The same without a tolerance: a tenth of what two meshes tell of a force, and pixels.
NEGLIGIBLE: dict[Kind, float] = {"share": 1e-4, "marker": 0.01}
# Of the probes' meshes.
FINENESS, ELEMENTS_MAX = 0.3, 1500
# Tolerances of the probes' states, and of those between waypoints: they move a worth by less than
# 1e-4 of the force.
STATES, PATHS = 1e-3, 1e-2
# What a probe may try: one that takes more would cost more than it can save, and tells nothing.
NEWTON_MAX, CG_MAX, HALVINGS = 30, 1500, 3
# Iterations of the linear solver that take as long as one Newton iteration beside them.
NEWTON = 50


@dataclass(frozen=True, slots=True)
class EffectWorth:
    """One effect of a scene, and what leaving it out changes."""

    name: str
    """`friction`, `viscosity`, `inertia` or `gravity`."""
    by: str
    """How that is known: `probe`, `bound` (it is less), or `no solution` of the probe."""
    change: Change | None = None
    """None where the probe found no solution."""
    time: float | None = None
    """Share of the run's time that the effect takes: 1 - work without it / work with it, work being
    iterations of the linear solver and 50 for each Newton iteration of the probes. Below 0 where
    the scene is harder without it; None where no probe ran without it."""
    left_out: bool = False
    """Whether the tolerance allows to do without it."""


@dataclass(frozen=True, slots=True)
class EffectsPlan:
    """What the effects of a scene are worth, and which of them a tolerance allows to leave out."""

    scene: Scene
    """With all its effects."""
    tolerance: Tolerance | None
    """None: nothing is left out."""
    effects: tuple[EffectWorth, ...]
    """Of all that are on, in the order of their worth, least first."""
    joint: Change
    """Error of all that is left out together, `SAFETY` included; nothing is 0."""
    joint_by: str
    """How that is known: `nothing left out`, `bounds`, `probe`, or `probe and bounds`."""
    time: float | None = None
    """Share of the run's time that is saved; as of `EffectWorth`."""
    probes: int = 0
    """How many scenes were solved to find out."""
    seconds: float = 0.0
    """Time that it took, bounds and probes [s]."""

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of what is left out."""
        return tuple(one.name for one in self.effects if one.left_out)

    @property
    def needed(self) -> Scene:
        """The scene without what is left out."""
        return without(self.scene, self.left_out)

    def record(self) -> dict[str, Any]:
        """Everything as plain JSON values; shares of the force and of the time in percent."""
        return {
            "asked": to_json(self.scene.effects),
            "kept": list(self.needed.effects.key),
            "left_out": list(self.left_out),
            "tolerance": None if self.tolerance is None else str(self.tolerance),
            "part": None if self.tolerance is None else _in_words(self.tolerance),
            "each": [
                {
                    "name": one.name,
                    "left_out": one.left_out,
                    "by": one.by,
                    **(_numbers(one.change) if one.change is not None else {}),
                    "time_percent": None if one.time is None else 100 * one.time,
                }
                for one in self.effects
            ],
            "joint": {"by": self.joint_by, **_numbers(self.joint), "safety": SAFETY},
            "time_percent": None if self.time is None else 100 * self.time,
            "probes": {
                "count": self.probes,
                "fineness": FINENESS,
                "seconds": round(self.seconds, 4),
            },
        }

    def __str__(self) -> str:
        """A table with a row for each effect, and a line on what is left out."""
        if not self.effects:
            return "the scene has no effects"
        rows: list[tuple[str, ...]] = [
            ("effect", "force", "force", "markers", "its time", "by", "")
        ]
        for one in reversed(self.effects):
            less = "< " if one.by == "bound" and one.change and one.change.force > 0 else ""
            kinds: tuple[Kind, ...] = ("share", "force", "marker")
            changes = ["?"] * 3
            if one.change is not None:
                changes = [less + with_unit(kind, one.change.value(kind)) for kind in kinds]
            spent = "" if one.time is None else f"{100 * max(one.time, 0.0):.0f} %"
            rows.append((one.name, *changes, spent, one.by, "left out" if one.left_out else ""))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        lines.append(self.summary())
        return "\n".join(lines)

    def summary(self) -> str:
        """What is left out and at what price, in a line."""
        spent = f"{self.probes} probes, {self.seconds:.1f} s"
        if self.tolerance is None:
            return f"what leaving one out changes; {spent}"
        limit = f"{_in_words(self.tolerance)} of {self.tolerance} is for effects"
        if not self.left_out:
            return f"nothing can be left out: {limit}; {spent}"
        worth = with_unit(self.tolerance.kind, self.joint.value(self.tolerance.kind))
        return (
            f"left out: {', '.join(self.left_out)}; together {worth} ({self.joint_by}), {limit}; "
            f"{spent}"
        )


def without(scene: Scene, names: Sequence[str]) -> Scene:
    """The scene without the effects `names`; the scene itself where there are none of them."""
    if not names:
        return scene
    return replace(scene, effects=replace(scene.effects, **dict.fromkeys(names)))


def plan_many(
    scenes: Sequence[Scene],
    *,
    tolerance: str | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> list[EffectsPlan]:
    """As `sim.plan`, of several scenes, whose probes are solved side by side.

    Raises:
        SceneError: As `sim.plan`.
    """
    wanted = None if tolerance is None else tolerance_of(tolerance)
    for scene in scenes:
        check_kind("scene", scene, Scene, "a Scene")
    drafts = [_Draft(scene, wanted) for scene in scenes]
    _solve(drafts, device, progress, (0, 2))
    for draft in drafts:
        draft.order()
    round_ = 1
    while any(draft.queue for draft in drafts):
        _solve(drafts, device, progress, (round_, round_ + 1))
        for draft in drafts:
            draft.judge()
        round_ += 1
    return [draft.plan() for draft in drafts]


def simulate_needed(
    scene: Scene,
    tolerance: str,
    *,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Result:
    """The scene within `tolerance`, without the effects that it may do without.

    Effects left out take up to a third of the tolerance, the mesh the rest of it; the sum of both
    errors is in `record["error"]`. `record["effects"]` is the plan, with the effects asked for;
    the result's scene has those that were solved.

    Args:
        scene: With all effects in question.
        tolerance: Such as "2 %", "0.05 N", "0.5 px".
        device: Where it runs.
        progress: Called with the share done, 0 to 1, of the probes and of each mesh in turn.

    Raises:
        SceneError: What is no tolerance, or one that the finest mesh allowed does not reach.
        SimulationDiverged: A mesh found no solution.
    """
    (found,) = plan_many([scene], tolerance=tolerance, device=device, progress=progress)
    if not found.left_out:
        result = simulate_within(scene, tolerance, device=device, progress=progress)
        return replace(result, record={**result.record, "effects": found.record()})
    wanted = tolerance_of(tolerance)
    spent = found.joint.value(wanted.kind)
    rest = _text(wanted.kind, wanted.value - spent)
    try:
        # Errors of effects and mesh are added, markers' too, which 'layer' does not state.
        result = simulate_within(found.needed, rest, tier="fem", device=device, progress=progress)
    except SceneError as refusal:
        raise SceneError(
            f"{refusal} (of {tolerance!r}, {with_unit(wanted.kind, spent)} is for "
            f"{', '.join(found.left_out)}, left out)"
        ) from refusal
    return _with_both_errors(result, found, wanted)


def _with_both_errors(result: Result, found: EffectsPlan, wanted: Tolerance) -> Result:
    """The result of the mesh, its error and that of the effects added up."""
    mesh, joint = result.record["error"], found.joint
    share = [a + b for a, b in zip(mesh["force"], joint.share, strict=True)]
    error = {
        **mesh,
        "by": f"{mesh['by']}; effects left out: {found.joint_by}",
        "percent": mesh["percent"] + 100 * joint.value("share"),
        "force": share,
        "newton": mesh["newton"] + joint.force,
        "marker": mesh["marker"] + joint.marker,
        "mesh_percent": mesh["percent"],
        "effects_percent": 100 * joint.value("share"),
    }
    plan = result.record["plan"]
    plan = {
        **plan,
        "tolerance": str(wanted),
        "notes": [*plan["notes"], f"the mesh within {plan['tolerance']}", found.summary()],
    }
    record = {**result.record, "error": error, "plan": plan, "effects": found.record()}
    return replace(result, record=record)


def part_of_tolerance(tolerance: Tolerance) -> float:
    """How much of a tolerance effects left out may take, in its unit."""
    part = PART * tolerance.value
    if tolerance.kind == "share":
        part = min(part, tolerance.value - FLOOR)
    return float(max(part, 0.0))


def _in_words(tolerance: Tolerance) -> str:
    return with_unit(tolerance.kind, part_of_tolerance(tolerance))


def _text(kind: Kind, value: float) -> str:
    """A tolerance as a person writes it, no larger than `value`: four digits, the rest cut off."""
    number, unit = {
        "share": (100 * value, "%"),
        "force": (value, "N"),
        "marker": (value, "px"),
    }[kind]
    digits = 3 - int(np.floor(np.log10(number)))
    return f"{np.floor(number * 10.0**digits) / 10.0**digits:.4g} {unit}"


def _numbers(change: Change) -> dict[str, float]:
    return {
        "percent": 100 * change.value("share"),
        "newton": change.force,
        "marker": change.marker,
    }


# The probes of one scene, from bounds to the largest set that may be left out.

Names = frozenset[str]


@dataclass
class _Draft:
    """A plan in the making; `queue` are the sets of effects to be left out in the next probes."""

    scene: Scene
    wanted: Tolerance | None
    bounded: dict[str, Change] = field(default_factory=dict)
    queue: list[Names] = field(default_factory=list)
    solved: dict[Names, Outcome] = field(default_factory=dict)
    candidates: list[Names] = field(default_factory=list)
    """Sets to be left out together, largest first."""
    chosen: Names = frozenset()
    """What is left out of the effects that were probed."""
    seconds: float = 0.0

    def __post_init__(self) -> None:
        """Bound what can be bounded; the rest, and the scene as it is, are to be probed."""
        began = time.perf_counter()
        names = self.scene.effects.key
        for name, change in bounds_of(self.scene, names).items():
            if self._spared(change):
                self.bounded[name] = change
        self.probed = [name for name in names if name not in self.bounded]
        if self.probed:
            self.queue = [frozenset(), *(frozenset({name}) for name in self.probed)]
        self.seconds += time.perf_counter() - began

    def _spared(self, change: Change) -> bool:
        if self.wanted is None:
            return all(change.value(kind) <= most for kind, most in NEGLIGIBLE.items())
        return change.value(self.wanted.kind) <= BOUND_PART * part_of_tolerance(self.wanted)

    def change(self, names: Names) -> Change | None:
        """What leaving out `names` changes, by the probes; None where one found no solution."""
        whole, less = self.solved.get(frozenset()), self.solved.get(names)
        if not (isinstance(whole, Result) and isinstance(less, Result)):
            return None
        return _between(whole, less)

    def time(self, names: Names) -> float | None:
        """Share of the work that `names` take; None where a probe found no solution."""
        whole, less = self.solved.get(frozenset()), self.solved.get(names)
        if not (isinstance(whole, Result) and isinstance(less, Result)):
            return None
        return 1.0 - _work(less) / _work(whole)

    def joint(self, names: Names) -> Change | None:
        """The error of leaving out `names` and all that is bounded, on the safe side."""
        total = no_change(self.scene)
        for change in self.bounded.values():
            total = total.plus(change)
        if not names:
            return total
        found = self.change(self._together(names))
        if found is None:
            return None
        force = np.linalg.norm(self._whole().force, axis=1)
        found = found.times(SAFETY)
        least = np.maximum(found.share, NOISE * (force > 0))
        found = Change(
            share=tuple(least.tolist()),
            force=max(found.force, NOISE * float(force.max())),
            marker=found.marker,
        )
        return total.plus(found)

    def _whole(self) -> Result:
        """The probe with all effects, where one without some of them has a change."""
        whole = self.solved[frozenset()]
        assert isinstance(whole, Result)
        return whole

    def _together(self, names: Names) -> Names:
        """What the probe that stands for `names` leaves out: several also what is bounded."""
        return names if len(names) < 2 else names | frozenset(self.bounded)

    def _fits(self, names: Names) -> bool:
        change = self.joint(names)
        if change is None or self.wanted is None:
            return False
        return change.value(self.wanted.kind) <= part_of_tolerance(self.wanted)

    def order(self) -> None:
        """After the first probes: which sets may be left out, the least worth first."""
        self.queue = []
        if self.wanted is None or not self.probed:
            return
        alone = [name for name in self.ordered() if self._fits(frozenset({name}))]
        self.candidates = [frozenset(alone[:count]) for count in range(len(alone), 0, -1)]
        self.judge()

    def judge(self) -> None:
        """Take the first candidate if it fits; the next one that is not known is to be probed."""
        self.queue = []
        while self.candidates:
            first = self.candidates[0]
            if self._together(first) not in self.solved:
                self.queue = [self._together(first)]
                return
            if self._fits(first):
                self.chosen, self.candidates = first, []
                return
            self.candidates.pop(0)

    def ordered(self) -> list[str]:
        """The effects that were probed, the least worth first; those without a solution last."""
        kind: Kind = "share" if self.wanted is None else self.wanted.kind

        def worth(name: str) -> float:
            change = self.change(frozenset({name}))
            return np.inf if change is None else change.value(kind)

        return sorted(self.probed, key=worth)

    def plan(self) -> EffectsPlan:
        """What was found."""
        leaves = self.wanted is not None
        each = [EffectWorth(name, "bound", self.bounded[name], None, leaves)
                for name in self.scene.effects.key if name in self.bounded]  # fmt: skip
        for name in self.ordered():
            one = frozenset({name})
            change = self.change(one)
            by = "probe" if change is not None else "no solution"
            each.append(EffectWorth(name, by, change, self.time(one), name in self.chosen))
        joint = self.joint(self.chosen) if leaves else None
        probed = "probe" if self.chosen else ""
        bounds = "bounds" if self.bounded and leaves else ""
        return EffectsPlan(
            scene=self.scene,
            tolerance=self.wanted,
            effects=tuple(each),
            joint=no_change(self.scene) if joint is None else joint,
            joint_by=" and ".join(filter(None, (probed, bounds))) or "nothing left out",
            time=self.time(self._together(self.chosen)) if self.chosen else None,
            probes=len(self.solved),
            seconds=self.seconds,
        )


def _solve(
    drafts: Sequence[_Draft], device: str, progress: Progress | None, part: tuple[int, int]
) -> None:
    """Solve what the drafts have in their queues, all side by side."""
    from sim.fem.numerics import Numerics

    tasks = [(draft, names) for draft in drafts for names in draft.queue]
    if not tasks:
        return
    numerics = Numerics(
        fineness=FINENESS,
        elements_max=ELEMENTS_MAX,
        tolerance=STATES,
        path_tolerance=PATHS,
        newton_max=NEWTON_MAX,
        cg_max=CG_MAX,
        halvings=HALVINGS,
    )
    began = time.perf_counter()
    outcomes = simulate_many(
        [without(draft.scene, sorted(names)) for draft, names in tasks],
        numerics=numerics,
        device=device,
        progress=None if progress is None else part_of(progress, *part),
    )
    each = (time.perf_counter() - began) / len(tasks)
    for (draft, names), outcome in zip(tasks, outcomes, strict=True):
        draft.solved[names] = outcome
        draft.seconds += each


def _between(whole: Result, less: Result) -> Change:
    """How far the probe without an effect is from the one with it."""
    one, reference = outcome_of(less), outcome_of(whole)
    force, share = force_errors(one, reference)
    pixels = marker_errors(one, reference, whole.scene.body)
    return Change(
        share=tuple(float(most) for most in share.max(axis=1)),
        force=float(force.max()),
        marker=float(np.sqrt(np.mean(pixels**2, axis=1)).max()),
    )


def _work(result: Result) -> float:
    quality = result.quality
    return float(quality.cg.sum() + NEWTON * quality.newton.sum())
