# mypy: ignore-errors
# Drives and reads Warp arrays, typed at run time; mypy cannot follow them.
"""Steps of a batch: presses advance together, each along its own path."""

import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sim.arrays import Array
from sim.device import loaded_together
from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.fem.assembly import Assembly, kernels_of
from sim.fem.contact import OVERLAPS
from sim.fem.mesh import Mesh
from sim.fem.newton import DET_FLOOR, PATIENCE, PATIENT, PATIENT_IN_ALL, ROUNDING, Newton
from sim.fem.outcome import (
    FOLD,
    LEAP,
    OVERLAP_MOST,
    PASSED,
    FrameCollector,
    Passage,
    Spent,
    advice,
    overlap_place,
    shares,
)
from sim.fem.sizing import Sizes, finer_at
from sim.result import Outcome, dumped, width_of
from sim.scene import Scene

# Samples along a side of a face at which overlap is measured, for frames and for intermediate
# states; and the number of states per step, its end included.
FRAME_SAMPLES, PATH_SAMPLES, PATH_STATES = 8, 3, 3
# Further updates of the multipliers where an indenter has all but left the skin: they remember the
# press before, and each leaves a tenth of it or less. Below this fraction of the largest force.
FADED, FADED_BELOW = 3, 0.01
# Tolerance of states from which the multipliers are updated, over that of the state after them,
# which is the result's.
UPDATED = 3.0
# Threads of the host that look at folded skins beside a GPU. Nearly half of their work holds the
# interpreter's lock, so that more threads wait for each other: two were 1.9 times as fast as one,
# six 1.5 times (two cores), and sixteen on sixteen cores slower than six.
THREADS = 3


class Crossed(SimulationDiverged):
    """No result, because the skin passes through itself or through the indenter.

    It has what `Result` has of the mesh, and `wanted`, the elements that may avoid it.
    """

    wanted: Sizes
    leaps: bool
    """True if the indenter is in the skin, False if the skin is in itself."""
    surface_x: np.ndarray
    """Positions of the nodes of the mesh (X,) [m]."""
    surface_y: np.ndarray
    """The same along y (Y,) [m]."""
    record: dict


# Time of `time.monotonic` at which solutions end.
_UNTIL: ContextVar[float] = ContextVar("until", default=math.inf)


class OutOfTime(Exception):
    """The time of `limited` is over."""


@contextmanager
def limited(until: float) -> Iterator[None]:
    """Let batches that run inside end with `OutOfTime` after a time of `time.monotonic`."""
    token = _UNTIL.set(until)
    try:
        yield
    finally:
        _UNTIL.reset(token)


def on_host(device: str, function: Callable[..., Any], *items: Iterable[Any]) -> list[Any]:
    """Return a function of the host for each of the items: in threads beside a GPU.

    A GPU's batch has many presses, and NumPy leaves the interpreter's lock to other threads.
    """
    if device == "cpu":
        return list(map(function, *items))
    from recorder.processes import cores

    with ThreadPoolExecutor(min(THREADS, cores())) as pool:
        return list(pool.map(function, *items))


# Path of one press along its motion: the choice of steps, and the halving of failed ones.

# Time [s] after which any material has relaxed: how long a body stood before a motion begins.
FULL_RELAXATION_TIME = 1e9
# Failed attempts, of ever shorter steps from one place, after which the next may take long.
PATIENT_AFTER = (2, 5)
# Determinant of the last accepted state, over the least accepted one, below which its elements are
# all but crushed; and the number of shorter and shorter steps that may then fail by crushing them.
NEARLY_CRUSHED, CRUSHED_MOST = 2.0, 2
# Failed steps from one place after which a brief path ends.
BRIEF = 4
# Residual of a failed step above which float64 does not help a brief path.
FAR = 0.02
# Steps of a path that may end with the skin inside itself, or leap through the indenter, and be
# halved. A shorter one may lead to a state without a fold; one that grows with the depth does so in
# any steps.
CROSSED_MOST = 3
# Largest ratio of a step to the last one that was accepted.
GROWTH = 1.5
# Steps per shortest relaxation time, and per time in which a shear wave crosses the body, but at
# most `STEPS_MAX` in a segment. `sim.fem.in_time` measures their error, and adds more.
RELAXATION_STEPS, CROSSING_STEPS = 4, 16
STEPS_MAX = 16
# Way of the tip in that time at the speed by which it changes, over the depth, below which a wave
# is not resolved; and the number of crossings for which it is.
SLOW, RINGING = 0.01, 10.0
# Longest step in sides of the smallest elements, if the mesh follows the contact, and the number of
# steps in the depth that need not be exceeded. Longer steps bring too many elements into contact at
# once, and Newton's method takes several times the iterations.
FINE_STEPS, DEPTH_STEPS = 1.0, 10.0


@dataclass(slots=True)
class Path:
    """Progress of one press along its motion; lengths in thicknesses.

    Segment 0 leads from above the body straight to the first waypoint, in no time: a motion that
    begins inside the body arrived there at once. Segment k leads to waypoint k. Weight acts from
    the start; if the body does not converge under all of it, it is ramped up over segment 0.
    """

    corners: Array
    """Start and waypoints (F + 1, 3)."""
    times: Array
    """Time of each corner [s] (F + 1,); the first is before the body was touched."""
    longest: float
    """Length of the longest step."""
    by_time: Array
    """Number of steps of each segment by inertia or viscosity (F,)."""
    halvings_max: int
    factor: int = 1
    """Factor on the number of steps."""
    heavy: bool = False
    """True if the body has weight."""
    ramped: bool = False
    """True if the weight is ramped up over segment 0."""
    segment: int = 0
    fraction: float = 0.0
    """Completed fraction of the segment."""
    step: float = 1.0
    """Fraction of the segment that the next step may take."""
    halvings: int = 0
    failed: int = 0
    """Failed attempts since the last accepted step."""
    brief: bool = False
    """True if it ends early, as its press goes on with a skin that stiffens."""
    hard: bool = False
    """True if another batch, in float32, has failed on this path."""
    patient_left: int = PATIENT_IN_ALL
    """Iterations that patient steps may still take."""
    nearly_crushed: bool = False
    """True if elements of the last accepted state have little volume left."""
    crushed: int = 0
    """Steps since then that failed because elements lost their volume."""
    crossed: int = 0
    """Steps of the whole path in which something has passed through the skin."""
    ended: str = ""
    """Reason why shorter steps are of no use, if so."""
    tried: list[str] = field(default_factory=list)

    @property
    def patient(self) -> bool:
        """True if the next step may take long, as shorter ones would not help."""
        waits = self.failed in PATIENT_AFTER or (self.hard and self.failed == 0)
        return waits and not self.brief

    def patience(self, newton_max: int) -> float:
        """Return how many times as many iterations as usual a patient step may take."""
        return 1.0 + min(PATIENT - 1.0, max(self.patient_left, 0) / newton_max)

    @property
    def finished(self) -> bool:
        """True if the last waypoint was reached."""
        return self.segment == len(self.corners) - 1

    @property
    def length(self) -> float:
        """Length of the current segment."""
        return self._length_of(self.segment)

    @property
    def limit(self) -> float:
        """Largest fraction of the segment that one step may take."""
        return 1.0 / self.steps_of(self.segment)

    @property
    def steps(self) -> float:
        """Number of steps of all segments, if none is halved."""
        return sum(self.steps_of(segment) for segment in range(len(self.corners) - 1))

    @property
    def shortest(self) -> float:
        """Duration of the shortest step [s], if none is halved; inf without waypoints but one."""
        lasts = np.diff(self.times)[1:]
        return min((t / self.steps_of(i) for i, t in enumerate(lasts, 1)), default=np.inf)

    def _length_of(self, segment: int) -> float:
        return float(np.linalg.norm(self.corners[segment + 1] - self.corners[segment]))

    def steps_of(self, segment: int) -> float:
        """Return the number of steps of a segment, if none is halved."""
        by_way = np.ceil(self._length_of(segment) / self.longest)
        steps = float(max(1.0, by_way, np.ceil(self.by_time[segment])))
        return steps * self.factor if segment else steps

    def goal(self) -> tuple[float, Array, float]:
        """Return the fraction of the segment after the next step, tip (3,), and time [s]."""
        step = min(self.step, self.limit)
        left = 1.0 - self.fraction
        step = left if left < 1.2 * step else min(step, left)
        fraction = 1.0 if step == left else self.fraction + step
        start, end = self.corners[self.segment], self.corners[self.segment + 1]
        duration = (self.times[self.segment + 1] - self.times[self.segment]) * step
        if self.segment == 0:
            duration = FULL_RELAXATION_TIME if self.length == 0 else 0.0
        return fraction, start + (end - start) * fraction, float(duration)

    def load(self, fraction: float) -> float:
        """Return the fraction of the weight that acts after a fraction of the current segment."""
        return fraction if self.ramped and self.segment == 0 else 1.0

    def accept(self, fraction: float, *, nearly_crushed: bool = False) -> bool:
        """Accept the step; return True if a waypoint was reached."""
        step = fraction - self.fraction
        self.failed = self.crushed = 0
        self.nearly_crushed = nearly_crushed
        if fraction < 1.0:
            self.fraction = fraction
            self.step = step * GROWTH
            return False
        travel = step * self.length
        self.segment += 1
        self.fraction, self.halvings = 0.0, 0
        self.tried.clear()
        self.step = 1.0
        if not self.finished and self.length > 0 and travel > 0:
            self.step = max(travel, 0.25 * self.longest) * GROWTH / self.length
        return True

    def go_on(self, halvings_max: int) -> None:
        """Try the failed step again, patiently, now with up to `halvings_max` halvings."""
        self.step *= 2.0**self.failed
        self.halvings, self.halvings_max, self.failed = 0, halvings_max, 0
        self.hard = True
        self.tried.clear()

    def refuse(
        self, fraction: float, message: str, *, crushed: bool = False, crossed: str = ""
    ) -> bool:
        """Reject the step and halve it; return True if there is a smaller one to try.

        `crushed` is set if its elements have lost their volume. `crossed` says where something has
        passed through its skin, if it has.
        """
        step = fraction - self.fraction
        self.tried.append(f"segment {self.segment}, step of {step:.3g} of it: {message}")
        self.ramped |= self.heavy and self.segment == 0 and self.fraction == 0
        self.step = step / 2
        self.halvings += 1
        self.failed += 1
        self.crushed += crushed
        self.crossed += bool(crossed)
        if crossed and (self.crossed == CROSSED_MOST or not self.length):
            self.ended = crossed
        elif self.brief and (self.crushed >= CRUSHED_MOST or self.failed >= BRIEF):
            self.ended = f"{self.failed} steps of falling length have no state"
        elif self.nearly_crushed and self.crushed >= CRUSHED_MOST:
            self.ended = "elements are crushed: the skin folds there, or is pressed flat"
        elif self.patient_left <= 0 and self.failed >= PATIENT_AFTER[0]:
            self.ended = f"{PATIENT_IN_ALL} further iterations have not led past such places"
        if self.ended:
            return False
        return self.halvings <= self.halvings_max and (
            self.length > 0 or (self.ramped and self.segment == 0)
        )


def path_of(scene: Scene, numerics: Fem, finest: float = np.inf) -> Path:
    """Return the path of a tip, in thicknesses; `finest` elements if the mesh follows it."""
    unit = scene.body.thickness
    tip = np.asarray(scene.motion.tip) / unit
    start = tip[0].copy()
    start[2] = max(start[2], 0.0)
    longest = max(scene.indenter.sharpest / 2, unit / 50)
    if numerics.step_travel is not None:
        longest = min(longest, numerics.step_travel)
    elif scene.effects.friction is not None:
        longest = min(longest, unit / 40)
    longest = min(longest, max(FINE_STEPS * finest * unit, scene.motion.depth_max / DEPTH_STEPS))
    return Path(
        corners=np.concatenate([start[None], tip]),
        times=np.concatenate([[0.0], np.asarray(scene.motion.time)]),
        longest=longest / unit,
        by_time=_steps_by_time(scene),
        halvings_max=numerics.halvings,
        factor=numerics.step_factor or 1,
        heavy=scene.effects.gravity is not None,
    )


def _steps_by_time(scene: Scene) -> Array:
    """Return the number of steps of each segment by relaxation times and waves (F,)."""
    motion, body = scene.motion, scene.body
    viscosity, inertia = scene.effects.viscosity, scene.effects.inertia
    begins, lasts = np.array(motion.time[:-1]), np.diff(motion.time)
    count = np.ones(len(lasts))
    if viscosity is not None:
        count = np.maximum(count, lasts / min(viscosity.times) * RELAXATION_STEPS)
    if inertia is not None and inertia.scale and len(lasts):
        at_once = body.shear_modulus * (1.0 + sum(viscosity.ratios if viscosity else ()))
        crossing = body.thickness * np.sqrt(inertia.scale * body.density / at_once)
        velocity = np.diff(np.asarray(motion.tip), axis=0) / lasts[:, None]
        change = np.linalg.norm(np.diff(velocity, axis=0, prepend=0.0), axis=1)
        waves = np.where(change * crossing > SLOW * motion.depth_max, begins, -np.inf)
        ringing = begins - np.maximum.accumulate(waves) < RINGING * crossing
        count = np.where(ringing, np.maximum(count, lasts / crossing * CROSSING_STEPS), count)
    return np.concatenate([[1.0], np.minimum(count, STEPS_MAX)])


# Batches of presses that advance together.


@dataclass(frozen=True, slots=True)
class Passed:
    """A step in which something has passed through the skin."""

    why: str
    """The reason, if the path ends there."""
    wanted: Sizes
    """Elements that may avoid it."""
    brief: str
    """The same in a few words."""


@dataclass(frozen=True, slots=True)
class Reached:
    """State of some environments when their batch ends, from which another one goes on."""

    history: dict[str, np.ndarray]
    """Result of `SolverState.history`."""
    collectors: list[FrameCollector]
    """Frames kept so far."""
    paths: list[Path]
    spent: list[Spent]
    seconds: float
    """Time of the batch."""


def batch_key(scene: Scene, mesh: Mesh) -> tuple[object, ...]:
    """Return the parts that presses of one batch share: unit of length, topology and kernels."""
    return scene.body.thickness, mesh.cells, kernels_of([scene])


class Batch:
    """Presses on meshes of one topology, each with a separate path and step.

    They begin at the first step, or where those of another batch have ended (`reached`).
    """

    def __init__(
        self,
        scenes,
        meshes,
        numerics,
        precision,
        device,
        meshed=0.0,
        progress=None,
        reached=None,
        stiffening=None,
    ) -> None:
        self._scenes, self._meshes, self._numerics = scenes, meshes, numerics
        self._progress = progress
        began = time.perf_counter()
        with loaded_together(device):
            self._assembly = Assembly(meshes, scenes, numerics, precision, device, stiffening)
            self._newton = Newton(self._assembly)
        self._collectors = list(map(FrameCollector, scenes, meshes))
        self._unmeasured: deque[FrameCollector] = deque()
        self._area = np.array([mesh.top_area for mesh in meshes])[..., None]
        self._stress = np.array([scene.body.modulus for scene in scenes])[:, None, None, None]
        self._paths: list[Path] = [
            path_of(scene, numerics, mesh.finest if np.isfinite(mesh.fineness) else np.inf)
            for scene, mesh in zip(scenes, meshes, strict=True)
        ]
        for path in self._paths:
            path.brief = numerics.follows and not self._assembly.stiffens
        self._seconds = {"mesh": meshed, "build": time.perf_counter() - began}
        self._failed: dict[int, SimulationDiverged] = {}
        count = len(scenes)
        self._spent = [Spent() for _scene in scenes]
        self._busy = np.zeros(count, bool)
        self._augmented = np.zeros(count, int)
        self._largest = np.zeros(count)  # force at a waypoint, by environment [E T^2]
        self._last = np.zeros((count, 2))
        self._deepest = np.zeros(count)  # overlap along the last accepted step [T]
        self._tip, self._share = np.zeros((count, 3)), np.zeros(count)
        self._duration, self._load = np.ones(count), np.ones(count)
        state = self._assembly.state
        state.start(np.array([path.corners[0] for path in self._paths]))
        self._before = 0.0
        if reached is not None:
            self._collectors, self._paths = reached.collectors, reached.paths
            self._spent, self._before = reached.spent, reached.seconds
            for path in self._paths:
                path.go_on(numerics.halvings)
            state.go_on(reached.history)

    def reached(self, chosen: list[int]) -> Reached:
        """Return the last accepted states of the chosen environments."""
        return Reached(
            history=self._assembly.state.history(chosen),
            collectors=[self._collectors[i] for i in chosen],
            paths=[self._paths[i] for i in chosen],
            spent=[self._spent[i] for i in chosen],
            seconds=self._seconds["solve"],
        )

    def may_go_on(self, env: int) -> bool:
        """True if an environment has failed where float64 may succeed.

        States far from balance are no matter of digits; where they end, a brief path does.
        """
        path, residual = self._paths[env], self._newton.residual[env]
        far = path.brief and not residual < FAR
        return env in self._failed and not path.ended and not far

    def run(self) -> list[Outcome]:
        """Advance all presses to their last waypoint, or until they fail; return the outcomes."""
        began = time.perf_counter()
        newton = self._newton
        while True:
            if time.monotonic() > _UNTIL.get():
                raise OutOfTime
            paths = enumerate(self._paths)
            open_ = np.array([not p.finished and i not in self._failed for i, p in paths])
            if not open_.any():
                break
            self._begin(open_ & ~self._busy)
            running = self._busy & ~newton.converged & ~newton.failed
            if running.any():
                newton.sweep(running, self._measure)
            self._finish(self._busy & (newton.converged | newton.failed))
        self._seconds["solve"] = self._before + time.perf_counter() - began
        record = self._record()

        def outcome(env: int) -> Outcome:
            failed, frames = self._failed.get(env), self._paths[env].segment
            if failed is None:
                return self._collectors[env].result(record, self._numerics)
            if frames > 1:
                some = self._collectors[env].up_to(frames)
                failed.reached = some.result(record, self._numerics)
            return failed

        return [outcome(env) for env in range(len(self._scenes))]

    def _begin(self, idle: np.ndarray) -> None:
        """Begin the next step of the idle environments (B,)."""
        if not idle.any():
            return
        guess, tolerance, patience = np.zeros((3, len(idle)))
        for i in np.flatnonzero(idle).tolist():
            path = self._paths[i]
            self._share[i], self._tip[i], self._duration[i] = path.goal()
            self._load[i] = path.load(self._share[i])
            tolerance[i] = self._tolerance(self._share[i], self._numerics.augmentations)
            patience[i] = path.patience(self._numerics.newton_max) if path.patient else 1.0
            segment, step = self._last[i]
            going_on = segment == path.segment and step > 0 and path.halvings == 0
            if going_on and "friction" in self._assembly.effects:
                guess[i] = min((self._share[i] - path.fraction) / step, 1.5)
        self._busy |= idle
        self._augmented[idle] = 0
        if "gravity" in self._assembly.effects:
            self._assembly.state.put_weight(self._load)
        self._assembly.state.begin_step(idle, self._tip, self._duration, guess)
        self._newton.begin(idle, tolerance, predict=guess == 0, patience=patience)

    def _tolerance(self, fraction: float, updates: int) -> float:
        """Return the tolerance of a state from which multipliers are updated `updates` times."""
        numerics = self._numerics
        if fraction >= 1.0:
            return numerics.tolerance * (UPDATED if updates else 1.0)
        loose = numerics.path_tolerance
        if loose is None:
            history = {"viscosity", "inertia"} & set(self._assembly.effects)
            loose = 1e-3 if history else 1e-2
        return max(loose, numerics.tolerance)

    def _finish(self, done: np.ndarray) -> None:
        """Accept the steps that have converged, halve those that have failed (B,)."""
        if not done.any():
            return
        assembly, newton = self._assembly, self._newton
        again, good, bad = np.zeros((3, len(done)), bool)
        tolerance = np.full(len(done), self._numerics.tolerance)
        force = np.linalg.norm(assembly.sums["contact"], axis=1)
        at_goal = done & newton.converged & (self._share >= 1.0)
        self._largest[at_goal] = np.maximum(self._largest, force)[at_goal]
        fades = force < FADED_BELOW * self._largest
        whole = np.where(force > 0, self._numerics.augmentations + FADED * fades, 0)
        for i in np.flatnonzero(done).tolist():
            spent = self._spent[i]
            spent.newton += int(newton.iterations[i])
            spent.cg += int(newton.cg[i])
            if self._augmented[i] or self._paths[i].patient:
                self._paths[i].patient_left -= max(0, int(newton.iterations[i]) - PATIENCE)
            if not newton.converged[i]:
                bad[i] = True
            elif at_goal[i] and self._augmented[i] < whole[i]:
                again[i] = True
                self._augmented[i] += 1
                tolerance[i] = self._tolerance(1.0, whole[i] - self._augmented[i])
            elif at_goal[i] and newton.residual[i] > tolerance[i]:  # nothing is touched
                again[i] = True
            else:
                good[i] = True
        if again.any():
            assembly.state.update_multiplier(assembly.state.mask(again))
            most = self._numerics.newton_max
            patience = np.array([path.patience(most) for path in self._paths])
            newton.resume(again, tolerance, patience)
        way, folds, passed = self._look(good)
        for i in passed:
            good[i], bad[i] = False, True
        self._take(good, way, folds)
        if bad.any():
            assembly.state.rollback_step(assembly.state.mask(bad))
        for i in np.flatnonzero(bad).tolist():
            self._spent[i].steps += 1
            reported = (
                f"{newton.iterations[i]} Newton iterations, residual {newton.residual[i]:.2e}"
            )
            self._last[i] = -1
            crushed, through = bool(newton.crushed[i]), passed.get(i)
            why = ""
            if through is not None:
                why, reported = through.why, f"{reported}; {through.brief}"
            more = self._paths[i].refuse(self._share[i], reported, crushed=crushed, crossed=why)
            if not more or self._is_rounding(i):
                self._failed[i] = self._diverged(i, through)
        self._busy &= ~(good | bad)

    def _look(
        self, good: np.ndarray
    ) -> tuple[np.ndarray, dict[int, tuple[float, int]], dict[int, Passed]]:
        """Measure the overlaps of completed steps (B,).

        Returns:
            Overlap along the steps (B, 4); results of `self_overlap`, by environment, of those that
            have folded; those in which something has passed through the skin.
        """
        assembly, folds, passed = self._assembly, {}, {}
        if not good.any():
            return np.zeros((len(good), OVERLAPS)), folds, passed
        way = assembly.overlap(assembly.state.mask(good), samples=PATH_SAMPLES, states=PATH_STATES)
        folded = np.flatnonzero(good & (way[:, 3] > 0)).tolist()
        leapt = self._leapt(good, way[:, 0])
        some = sorted({*folded, *leapt})
        if not some:
            return way, folds, passed
        top = assembly.read(some, self._tip)[1]
        touched = dict(zip(some, top[..., 3:].any(axis=-1), strict=True))
        if folded:
            from sim.fem.self_overlap import self_overlap

            displaced = assembly.rows(assembly.state.u, folded).astype(float)
            meshes = [self._meshes[i] for i in folded]
            results = on_host(assembly.device, self_overlap, meshes, displaced)
            folds.update(zip(folded, results, strict=True))
        overlaps = [
            (i, deep, self._meshes[i].nodes[node], FOLD)
            for i, (deep, node) in folds.items()
            if deep > PASSED * assembly.finest[i] and not assembly.stiffens
        ]
        overlaps += [(i, float(way[i, 0]), point, LEAP) for i, point in leapt.items()]
        for i, deep, point, kind in overlaps:
            through = self._too_deep(i, deep, point, touched[i], kind)
            if through is not None:
                passed[i] = through
        return way, folds, passed

    def _leapt(self, good: np.ndarray, way: np.ndarray) -> dict[int, np.ndarray]:
        """Return completed steps (B,) along which the skin leaps through the indenter.

        On the way it is deeper inside (`way` (B,) [T], just measured) than at both ends, by more
        than the tip has moved.

        Returns:
            By environment, the undeformed point of the skin that is deepest (3,) [T].
        """
        assembly, state = self._assembly, self._assembly.state
        allowed = np.maximum(PASSED * assembly.finest, np.linalg.norm(state.step, axis=1))
        may_be = good & (way > self._deepest + allowed)
        if not may_be.any():
            return {}
        points = {}
        for i in np.flatnonzero(may_be).tolist():
            mesh, overlap = self._meshes[i], assembly.rows(assembly.face_overlap, [i])[0, :, 0]
            points[i] = mesh.nodes[mesh.faces[np.argmax(overlap)]].mean(axis=0)
        end = assembly.overlap(state.mask(may_be), samples=PATH_SAMPLES)[:, 0]
        return {i: point for i, point in points.items() if way[i] > end[i] + allowed[i]}

    def _too_deep(
        self, env: int, deep: float, point: np.ndarray, touched: np.ndarray, kind: Passage
    ) -> Passed | None:
        """Return what to say of an overlap, or None if it is small for the contact.

        It is `deep` [T] at an undeformed point (3,) [T], where nodes of the top touch (X, Y).
        """
        mesh, unit = self._meshes[env], self._scenes[env].body.thickness
        x, y, point = mesh.x * unit, mesh.y * unit, point * unit
        width, tip = np.array([width_of(touched, x, y)]), self._tip[[env]] * unit
        (fraction,) = shares(np.array([deep * unit]), width, tip, unit)
        if fraction <= OVERLAP_MOST:
            return None
        description = kind.words.format(overlap_place(point, deep * unit, kind.inside, fraction))
        return Passed(description, finer_at(point, x, y, mesh.fineness), kind.brief)

    def _is_rounding(self, env: int) -> bool:
        """True if a step failed so close to its tolerance that float32 rounding is the limit.

        A smaller step would fail too.
        """
        if self._numerics.precision != "auto" or self._assembly.precision != "float32":
            return False
        tolerance = self._numerics.tolerance
        return bool(tolerance < self._newton.residual[env] < ROUNDING * tolerance)

    def _take(self, good: np.ndarray, way: np.ndarray, folds: dict[int, tuple[float, int]]) -> None:
        if not good.any():
            return
        assembly = self._assembly
        reached: dict[int, int] = {}
        work = self._newton.work(good, self._duration)
        for i in np.flatnonzero(good).tolist():
            path = self._paths[i]
            self._spent[i].steps += 1
            self._last[i] = path.segment, self._share[i] - path.fraction
            self._collectors[i].moved(float(work[i]), way[i])
            self._deepest[i] = way[i, 0]
            frame = path.segment
            floor = NEARLY_CRUSHED * DET_FLOOR
            if path.accept(self._share[i], nearly_crushed=bool(assembly.sums["det"][i] < floor)):
                reached[i] = frame
        if reached:
            self._keep(reached, folds)
        assembly.accept(good, self._duration)
        if self._progress is not None:
            done = sum(path.segment + path.fraction - 1 for path in self._paths)
            whole = sum(max(len(path.corners) - 2, 1) for path in self._paths)
            self._progress(max(done, 0.0) / whole)

    def _keep(self, reached: dict[int, int], folds: dict[int, tuple[float, int]]) -> None:
        """Keep current states as frames, given by environment."""
        assembly, some, unit = self._assembly, list(reached), self._scenes[0].body.thickness
        keeping = np.isin(np.arange(len(self._paths)), some)
        assembly.measure_overlap(assembly.state.mask(keeping), samples=FRAME_SAMPLES)
        read, top = assembly.read(some, self._tip)
        surface = top[..., :3] * unit
        traction = top[..., 3:] / self._area[some] * self._stress[some]
        sums, residual, depth = assembly.sums, self._newton.residual, -self._tip[:, 2]
        for row, (i, frame) in enumerate(reached.items()):
            deep, node = folds.get(i, (0.0, -1))
            least = assembly.min_force_scale[i]
            state = depth[i], residual[i], sums["base"][i], sums["det"][i], least
            host = *state, deep, node, self._spent[i]
            self._collectors[i].keep(frame, read[row], surface[row], traction[row], host)
            self._unmeasured.append(self._collectors[i])
            self._spent[i] = Spent()
        rounds = [i for i in reached if self._collectors[i].round is not None]
        if rounds:
            columns = assembly.rows(assembly.state.u, rounds).astype(float)
            faces = assembly.rows(assembly.state.contact.touched, rounds)
            for i, u, touched in zip(rounds, columns, faces, strict=True):
                self._collectors[i].keep_round(reached[i], u, touched, self._tip[i])

    def _measure(self, is_busy: Callable[[], bool]) -> None:
        """Measure the contacts of kept frames while a GPU is busy, the rest for the results."""
        while self._unmeasured and is_busy():
            self._unmeasured.popleft().measure()

    def _diverged(self, env: int, through: Passed | None = None) -> SimulationDiverged:
        path, scene = self._paths[env], self._scenes[env]
        state = self._assembly.state
        dump = dumped(
            scene=json.dumps(repr(scene)),
            tip=state.tip_before[env] * scene.body.thickness,
            u=state.contact.u_old.numpy()[env] * scene.body.thickness,
            nodes=self._meshes[env].nodes * scene.body.thickness,
        )
        tip = path.corners[path.segment] + path.fraction * (
            path.corners[path.segment + 1] - path.corners[path.segment]
        )
        weight = ""
        if path.ramped and path.segment == 0:
            pull = ", ".join(f"{value:g}" for value in scene.effects.gravity.acceleration)
            weight = (
                f" under {100 * path.fraction:.3g} % of gravity's ({pull}) m/s^2, applied "
                "in steps (the body may be too soft to carry its weight)"
            )
        millimetres = tip * scene.body.thickness * 1e3
        says_more = through is not None and path.ended == through.why  # it says what is allowed
        missing = "no converged state" if through is None else "no state without overlap"
        diverged = (SimulationDiverged if through is None else Crossed)(
            f"{missing} after the tip at ({millimetres[0]:.4g}, {millimetres[1]:.4g}, "
            f"{millimetres[2]:.4g}) mm, on the way to waypoint {path.segment}{weight}: "
            f"{path.ended + '; ' if path.ended else ''}"
            f"{len(path.tried)} steps failed, the last: {path.tried[-1]}; "
            f"{'' if says_more else advice(scene)}{self._assembly.precision}; "
            f"state: {dump or 'could not be written'}",
            tried=tuple(path.tried),
            dump=dump,
        )
        if isinstance(diverged, Crossed):
            mesh, unit = self._meshes[env], scene.body.thickness
            diverged.wanted, diverged.record = through.wanted, self._record()
            diverged.leaps = through.brief == LEAP.brief
            diverged.surface_x, diverged.surface_y = mesh.x * unit, mesh.y * unit
        return diverged

    def _record(self) -> dict:
        assembly = self._assembly
        return {
            "tier": "fem",
            "mesh": {
                "cells": list(assembly.mesh.cells),
                "elements": len(assembly.mesh.elements),
                "nodes": len(assembly.mesh.nodes),
            },
            "precision": assembly.precision,
            "device": str(assembly.device),
            "environments": assembly.environments,
            "effects": list(assembly.effects),
            "seconds": {name: round(value, 4) for name, value in self._seconds.items()},
        }
