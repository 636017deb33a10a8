"""Selection of the effects that a scene needs, by their influence on coarse meshes.

A probe is the scene on a coarse `fem` mesh without some of its effects. Its difference from the
probe with all of them measures their influence: both have the same mesh, whose own error mostly
cancels. Where dimensions show that an effect is far below the relevant size (`sim.effect_bounds`),
it needs no probe. Effects are left out in the order of their influence, as many as a probe without
all of them together allows.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from recorder.progress import part_of
from sim.effect_bounds import Change, bounds_of, no_change
from sim.errors import SceneError, check_kind
from sim.fem import Fem
from sim.metrics import (
    Kind,
    Tolerance,
    force_errors,
    marker_errors,
    outcome_of,
    tolerance_of,
    with_unit,
)
from sim.result import ContactTier, Outcome, Result, to_json
from sim.scene import Scene
from sim.tiers import simulate_many
from sim.tolerance import FLOOR, simulate_within

Progress = Callable[[float], None]

# Fraction of a tolerance that left-out effects may use; the rest is for the mesh.
PART = 1 / 3
# Largest error by leaving out effects on a finer mesh over that of the probes: up to 1.34 in 22
# random scenes, except for one whose error was below `NOISE` (`benchmarks accuracy`).
SAFETY = 1.5
# Least error of a force, over the force, that probes resolve: their states are found along
# different steps, and with a remaining penetration.
NOISE = 5e-4
# Fraction of that part below which a bound makes a probe unnecessary.
BOUND_PART = 0.1
# Such limits without a tolerance: a tenth of the resolution of a force by two meshes, and pixels.
NEGLIGIBLE: dict[Kind, float] = {"fraction": 1e-4, "marker": 0.01}
# Fineness and most elements of the probes' meshes.
FINENESS, ELEMENTS_MAX = 0.3, 1500
# Tolerances of the probes' states, at and between waypoints: they change an influence by less than
# 1e-4 of the force.
STATES, PATHS = 1e-3, 1e-2
# Limits of a probe: one that needs more would cost more than it can save, and counts as failed.
NEWTON_MAX, CG_MAX, HALVINGS = 30, 1500, 3
# Iterations of the linear solver that take as long as the rest of one Newton iteration.
NEWTON = 50


@dataclass(frozen=True, slots=True)
class EffectWorth:
    """One effect of a scene, and the change by leaving it out."""

    name: str
    """`friction`, `viscosity`, `inertia` or `gravity`."""
    by: str
    """Source of the change: `probe`, `bound` (it is less), or why there is none: `no solution` of
    the probe, or `no contact` in it, so that it tells nothing of forces."""
    change: Change | None = None
    """None without a source."""
    time: float | None = None
    """Fraction of the run's time that the effect takes: 1 - work without it / work with it. Work is
    iterations of the linear solver and 50 for each Newton iteration of the probes. Negative if the
    scene is harder without it; None if no probe ran without it."""
    omitted: bool = False
    """True if the tolerance allows leaving it out."""


@dataclass(frozen=True, slots=True)
class EffectsPlan:
    """Influence of a scene's effects, and the selection that a tolerance allows to leave out."""

    scene: Scene
    """Scene with all its effects."""
    tolerance: Tolerance | None
    """None: no effect is left out."""
    effects: tuple[EffectWorth, ...]
    """All active effects, in the order of their influence, least first."""
    joint: Change
    """Error of leaving out all of the selection together, `SAFETY` included; 0 if it is empty."""
    joint_by: str
    """Source of the error: `nothing left out`, `bounds`, `probe`, or `probe and bounds`."""
    time: float | None = None
    """Fraction of the run's time that is saved; as in `EffectWorth`."""
    probes: int = 0
    """Number of scenes that were solved for the plan."""
    seconds: float = 0.0
    """Time for bounds and probes [s]."""

    @property
    def omitted(self) -> tuple[str, ...]:
        """Names of the effects that are left out."""
        return tuple(one.name for one in self.effects if one.omitted)

    @property
    def needed(self) -> Scene:
        """Scene without the effects that are left out."""
        return without(self.scene, self.omitted)

    @property
    def rest(self) -> str:
        """Tolerance that remains for the mesh, as text."""
        assert self.tolerance is not None
        return _text(
            self.tolerance.kind, self.tolerance.value - self.joint.value(self.tolerance.kind)
        )

    def record(self) -> dict[str, Any]:
        """Return the plan as plain JSON values; fractions of force and time are in percent."""
        return {
            "asked": to_json(self.scene.effects),
            "kept": list(self.needed.effects.key),
            "left_out": list(self.omitted),
            "tolerance": None if self.tolerance is None else str(self.tolerance),
            "part": None if self.tolerance is None else _in_words(self.tolerance),
            "each": [
                {
                    "name": one.name,
                    "left_out": one.omitted,
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
        """Return a table with a row for each effect, and a summary line."""
        if not self.effects:
            return "the scene has no effects"
        rows: list[tuple[str, ...]] = [
            ("effect", "force", "force", "markers", "its time", "by", "")
        ]
        for one in reversed(self.effects):
            less = "< " if one.by == "bound" and one.change and one.change.force > 0 else ""
            kinds: tuple[Kind, ...] = ("fraction", "force", "marker")
            changes = ["?"] * 3
            if one.change is not None:
                changes = [less + with_unit(kind, one.change.value(kind)) for kind in kinds]
            spent = "" if one.time is None else f"{100 * max(one.time, 0.0):.0f} %"
            rows.append((one.name, *changes, spent, one.by, "left out" if one.omitted else ""))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        lines.append(self.summary())
        return "\n".join(lines)

    def summary(self) -> str:
        """Return one line with the effects that are left out and their error."""
        spent = f"{self.probes} probes, {self.seconds:.1f} s"
        if self.tolerance is None:
            return f"changes if one effect is left out; {spent}"
        limit = f"{_in_words(self.tolerance)} of {self.tolerance} is for effects"
        if not self.omitted:
            return f"nothing can be left out: {limit}; {spent}"
        worth = with_unit(self.tolerance.kind, self.joint.value(self.tolerance.kind))
        return (
            f"left out: {', '.join(self.omitted)}; together {worth} ({self.joint_by}), {limit}; "
            f"{spent}"
        )


def without(scene: Scene, names: Sequence[str]) -> Scene:
    """Return the scene without the effects `names`; the scene itself if there are none."""
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
    """Plan several scenes as `sim.plan_effects` does, with the probes solved in one batch."""
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
    effects_plan: EffectsPlan,
    tolerance: str,
    *,
    tier: ContactTier | None = None,
    device: str = "cpu",
    progress: Progress | None = None,
) -> Result:
    """Simulate within `tolerance`, without the effects that its plan leaves out.

    Left-out effects take up to a third of the tolerance, the mesh the rest of it; the sum of both
    errors is in `record["error"]`. `record["effects"]` is the plan, with the requested effects;
    the result's scene has those that were solved.

    Args:
        effects_plan: Plan for this tolerance of the scene with all requested effects.
        tolerance: Such as "2 %", "0.05 N", "0.5 px".
        tier: As in `simulate_within`; None is `fem` if effects are left out.
        device: Device to run on.
        progress: Called with the fraction done, 0 to 1, of each mesh in turn.
    """
    if not effects_plan.omitted:
        result = simulate_within(
            effects_plan.scene, tolerance, tier=tier, device=device, progress=progress
        )
        return replace(result, record={**result.record, "effects": effects_plan.record()})
    wanted = tolerance_of(tolerance)
    spent = effects_plan.joint.value(wanted.kind)
    try:
        # Errors of effects and mesh are added, also those of markers, which 'layer' does not state.
        result = simulate_within(
            effects_plan.needed,
            effects_plan.rest,
            tier=tier or "fem",
            device=device,
            progress=progress,
        )
    except SceneError as refusal:
        raise SceneError(
            f"{refusal} (of {tolerance!r}, {with_unit(wanted.kind, spent)} is for "
            f"{', '.join(effects_plan.omitted)}, left out)"
        ) from refusal
    return _with_both_errors(result, effects_plan, wanted)


def _with_both_errors(result: Result, effects_plan: EffectsPlan, wanted: Tolerance) -> Result:
    """Return the mesh's result with the sum of its error and that of the effects."""
    mesh, joint = result.record["error"], effects_plan.joint
    fraction = [a + b for a, b in zip(mesh["force"], joint.fraction, strict=True)]
    error = {
        **mesh,
        "by": f"{mesh['by']}; effects left out: {effects_plan.joint_by}",
        "percent": mesh["percent"] + 100 * joint.value("fraction"),
        "force": fraction,
        "newton": mesh["newton"] + joint.force,
        **({"marker": mesh["marker"] + joint.marker} if "marker" in mesh else {}),
        "mesh_percent": mesh["percent"],
        "effects_percent": 100 * joint.value("fraction"),
    }
    plan = result.record["plan"]
    plan = {
        **plan,
        "tolerance": str(wanted),
        "notes": [*plan["notes"], f"the mesh within {plan['tolerance']}", effects_plan.summary()],
    }
    record = {**result.record, "error": error, "plan": plan, "effects": effects_plan.record()}
    return replace(result, record=record)


def part_of_tolerance(tolerance: Tolerance) -> float:
    """Return the part of a tolerance that left-out effects may use, in its unit."""
    part = PART * tolerance.value
    if tolerance.kind == "fraction":
        part = min(part, tolerance.value - FLOOR)
    return float(max(part, 0.0))


def _in_words(tolerance: Tolerance) -> str:
    return with_unit(tolerance.kind, part_of_tolerance(tolerance))


def _text(kind: Kind, value: float) -> str:
    """Return a tolerance as text, rounded down to four digits."""
    number, unit = {
        "fraction": (100 * value, "%"),
        "force": (value, "N"),
        "marker": (value, "px"),
    }[kind]
    digits = 3 - int(np.floor(np.log10(number)))
    return f"{np.floor(number * 10.0**digits) / 10.0**digits:.4g} {unit}"


def _numbers(change: Change) -> dict[str, float]:
    return {
        "percent": 100 * change.value("fraction"),
        "newton": change.force,
        "marker": change.marker,
    }


# Probes of one scene, from bounds to the largest set that may be left out.

Names = frozenset[str]


@dataclass
class _Draft:
    """Plan under construction; `queue` has the sets of effects that the next probes leave out."""

    scene: Scene
    wanted: Tolerance | None
    bounded: dict[str, Change] = field(default_factory=dict)
    queue: list[Names] = field(default_factory=list)
    solved: dict[Names, Outcome] = field(default_factory=dict)
    candidates: list[Names] = field(default_factory=list)
    """Sets that may be left out together, largest first."""
    chosen: Names = frozenset()
    """Probed effects that are left out."""
    seconds: float = 0.0

    def __post_init__(self) -> None:
        """Bound effects where possible; queue probes of the others, and one with all effects."""
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
        """Return the probes' change by leaving out `names`; None without solutions or contact."""
        whole, less = self.solved.get(frozenset()), self.solved.get(names)
        if not (isinstance(whole, Result) and isinstance(less, Result)) or self._misses(whole):
            return None
        return _between(whole, less)

    def _misses(self, whole: Result) -> bool:
        """True if the probe has no force, and forces matter: a finer mesh may well touch."""
        of_force = self.wanted is None or self.wanted.kind != "marker"
        return of_force and self.scene.motion.depth_max > 0 and not whole.force.any()

    def time(self, names: Names) -> float | None:
        """Return the fraction of the work that `names` take; None if a probe found no solution."""
        whole, less = self.solved.get(frozenset()), self.solved.get(names)
        if not (isinstance(whole, Result) and isinstance(less, Result)):
            return None
        return 1.0 - _work(less) / _work(whole)

    def joint(self, names: Names) -> Change | None:
        """Return an upper bound of the error of leaving out `names` and all bounded effects."""
        total = no_change(self.scene)
        for bound in self.bounded.values():
            total = total.plus(bound)
        if not names:
            return total
        change = self.change(self._all_of(names))
        if change is None:
            return None
        force = np.linalg.norm(self._whole().force, axis=1)
        change = change.times(SAFETY)
        least = np.maximum(change.fraction, NOISE * (force > 0))
        change = Change(
            fraction=tuple(least.tolist()),
            force=max(change.force, NOISE * float(force.max())),
            marker=change.marker,
        )
        return total.plus(change)

    def _whole(self) -> Result:
        """Return the probe with all effects; only called if it has a solution."""
        whole = self.solved[frozenset()]
        assert isinstance(whole, Result)
        return whole

    def _all_of(self, names: Names) -> Names:
        """Return the effects that the probe of `names` omits: for several, bounded ones too."""
        return names if len(names) < 2 else names | frozenset(self.bounded)

    def _fits(self, names: Names) -> bool:
        change = self.joint(names)
        if change is None or self.wanted is None:
            return False
        return change.value(self.wanted.kind) <= part_of_tolerance(self.wanted)

    def order(self) -> None:
        """After the first probes, list the sets that may be left out, least influence first."""
        self.queue = []
        if self.wanted is None or not self.probed:
            return
        alone = [name for name in self.ordered() if self._fits(frozenset({name}))]
        self.candidates = [frozenset(alone[:count]) for count in range(len(alone), 0, -1)]
        self.judge()

    def judge(self) -> None:
        """Choose the first candidate if it fits; queue a probe of the next one that needs it."""
        self.queue = []
        while self.candidates:
            first = self.candidates[0]
            if self._all_of(first) not in self.solved:
                self.queue = [self._all_of(first)]
                return
            if self._fits(first):
                self.chosen, self.candidates = first, []
                return
            self.candidates.pop(0)

    def ordered(self) -> list[str]:
        """Return the probed effects, least influence first; those without a solution last."""
        kind: Kind = "fraction" if self.wanted is None else self.wanted.kind

        def worth(name: str) -> float:
            change = self.change(frozenset({name}))
            return np.inf if change is None else change.value(kind)

        return sorted(self.probed, key=worth)

    def plan(self) -> EffectsPlan:
        """Return the finished plan."""
        leaves = self.wanted is not None
        each = [EffectWorth(name, "bound", self.bounded[name], None, leaves)
                for name in self.scene.effects.key if name in self.bounded]  # fmt: skip
        for name in self.ordered():
            one = frozenset({name})
            change = self.change(one)
            solved = isinstance(self.solved.get(one), Result)
            by = "probe" if change is not None else "no contact" if solved else "no solution"
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
            time=self.time(self._all_of(self.chosen)) if self.chosen else None,
            probes=len(self.solved),
            seconds=self.seconds,
        )


def _solve(
    drafts: Sequence[_Draft], device: str, progress: Progress | None, part: tuple[int, int]
) -> None:
    """Solve the queued probes of all drafts in one batch."""
    tasks = [(draft, names) for draft in drafts for names in draft.queue]
    if not tasks:
        return
    numerics = Fem(
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
        numerics,
        device=device,
        progress=None if progress is None else part_of(progress, *part),
    )
    each = (time.perf_counter() - began) / len(tasks)
    for (draft, names), outcome in zip(tasks, outcomes, strict=True):
        draft.solved[names] = outcome
        draft.seconds += each


def _between(whole: Result, less: Result) -> Change:
    """Return the difference of the probe without an effect from the one with it."""
    one, reference = outcome_of(less), outcome_of(whole)
    force, fraction = force_errors(one, reference)
    pixels = marker_errors(one, reference, whole.scene.body)
    return Change(
        fraction=tuple(float(most) for most in fraction.max(axis=1)),
        force=float(force.max()),
        marker=float(np.sqrt(np.mean(pixels**2, axis=1)).max()),
    )


def _work(result: Result) -> float:
    quality = result.quality
    return float(quality.cg.sum() + NEWTON * quality.newton.sum())
