"""Plan of presses that identify a twin: which indenters, depths, shears and holds tell most."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from sim.arrays import Array, Progress
from sim.errors import SceneError
from sim.layer.spectral import FEWEST
from sim.sensors import SimulatedSensor
from sim.sensors.quantities import quantities
from sim.twin.fit import (
    BENCH,
    COARSER,
    Data,
    Uncertainty,
    information,
    prior_spread,
    with_effects,
)
from sim.twin.model import TrackModel
from sim.twin.observations import PressTrack, track_of
from trajectories import PressShear

# Speed of the tip, height from which it comes [m], rate of poses and forces [Hz], rest above [s].
SPEED, ABOVE, RATE, FREE = 5e-3, 0.3e-3, 200.0, 0.5
# Depths in steps of a part of the deepest, shears as parts of the deepest, holds of the longest.
LEVELS, STEP, SHEARS, HOLDS = 2, 0.4, (0.25, 0.65), (0.4, 1.0)
# Longest hold over the longest relaxation time, and shortest of them [s].
RELAXED, LEAST_HOLD = 3.0, 0.3
# Timing error between arm and gauge [s]; relative error of all forces of an indenter, by its print.
TIMING, PRINT = 20e-3, 0.02
# Relative error of the law at rest: the median misfit of 200 fits to planted skins, whose spreads a
# plan then foretells (docs/results/twin.md: modulus 4.1 %, thickness 8 %, friction 2 %).
MISFIT = 0.016
# Difference of a press's forces on a rougher grid, over the largest of them, above which it is not
# chosen: as a tip or a thin edge crosses pixels, slopes are noise, which passes for information.
# On 64 pixels smooth tips are below 1.2 %, most presses by edges above 1.3 %; both are as large as
# a pixel.
ROUGH, ROUGH_GRID = 0.0125, 64


@dataclass(frozen=True, slots=True)
class PlannedPresses:
    """Presses by one indenter at the sensor's centre, which end in a rest after every move."""

    indenter: str
    plan: PressShear
    hold: float
    """Time at rest after each move in contact [s]."""

    def path(self) -> tuple[Array, Array]:
        """Return corners of the path: times (k,) [s] and tips (k, 3) [m]."""
        return _path(self)

    @property
    def depths(self) -> tuple[float, ...]:
        """Depths [m]."""
        return tuple(dict.fromkeys(target.depth for target in self.plan.targets()))

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.path()[0][-1])


@lru_cache(maxsize=4096)
def _path(each: PlannedPresses) -> tuple[Array, Array]:
    time, tips = [0.0, FREE], [np.array([0.0, 0.0, each.plan.clearance])] * 2
    for target in each.plan.targets():
        for move in each.plan.moves(target):
            end = np.array(move.end)
            way = float(np.linalg.norm(end - tips[-1]))
            time.append(time[-1] + max(way / SPEED, 1e-3))
            time.append(time[-1] + (each.hold if end[2] < 0 else FREE))
            tips += [end, end]
    return np.array(time), np.array(tips)


def planned_presses(
    indenter: str, depths: Sequence[float], shear: float, hold: float
) -> PlannedPresses:
    """Return presses to depths [m], which are multiples of the first, each with a shear [m]."""
    plan = PressShear(
        step_x=1e-3,
        step_y=1e-3,
        depth_step=depths[0],
        depth_max=depths[-1],
        angle_step=2 * math.pi,
        shear=shear,
        clearance=ABOVE,
        points=(1,),
    )
    return PlannedPresses(indenter, plan, hold)


@dataclass(frozen=True, slots=True, eq=False)
class Expected(Uncertainty):
    """Uncertainty that a fit to some presses is expected to have."""

    @property
    def volume(self) -> float:
        """Logarithm of the determinant of the sensor's part, the bench's quantities unknown."""
        rows = [index for index, name in enumerate(self.names) if name not in BENCH]
        return float(np.linalg.slogdet(self.covariance[np.ix_(rows, rows)])[1])


class Planner:
    """Information of presses on a design, whose values are taken as true, before any is pressed.

    `noise` is the standard deviation of a sample of the gauge [N], `law` the relative error of the
    law at rest.
    """

    def __init__(
        self, design: SimulatedSensor, *, noise: float = 0.01, law: float = MISFIT, grid: int = 64
    ) -> None:
        self.design = with_effects(design)
        self.names = (*quantities(self.design), *BENCH)
        self._noise, self._law, self._grid = noise, law, grid
        self._information: dict[PlannedPresses, Array] = {}
        self._grid_error: dict[PlannedPresses, float] = {}

    def candidates(self, indenters: Sequence[str]) -> list[PlannedPresses]:
        """Return one press for each indenter, depth, shear and hold."""
        deepest = self.design.depth_max
        viscosity = self.design.effects.viscosity
        assert viscosity is not None
        longest = max(RELAXED * max(viscosity.times), LEAST_HOLD)
        return [
            planned_presses(name, (level * _round(STEP * deepest),), _round(shear * deepest), hold)
            for name in indenters
            for level in range(1, LEVELS + 1)
            for shear in SHEARS
            for hold in (round(part * longest, 2) for part in HOLDS)
        ]

    def usual(self) -> list[PlannedPresses]:
        """Return two presses by a sphere and two by a prism, with the longest shear and hold."""
        candidates = self.candidates(("sphere", "prism"))
        most = max(candidates, key=lambda each: (each.plan.shear, each.hold))
        return [
            each
            for each in candidates
            if (each.plan.shear, each.hold) == (most.plan.shear, most.hold)
        ]

    def expected(self, chosen: Sequence[PlannedPresses]) -> Expected:
        """Return the uncertainty after some presses."""
        return self._expected(sum((self.information(each) for each in chosen), self._prior))

    def information(self, each: PlannedPresses) -> Array:
        """Return the information (p, p) of presses: the inverse of a covariance."""
        if each not in self._information:
            track = self._track(each)
            model, rougher = (
                TrackModel(self.design, [track], grid=pixels)
                for pixels in (self._grid, max(FEWEST, round(COARSER * self._grid)))
            )
            values = {**quantities(self.design), **dict.fromkeys(BENCH, 0.0)}
            near = model.linearised(values, self.names)
            (force,), (rough,) = near.readings, rougher.readings(values)
            # `_common` scales errors by the track's forces, which are those of the model here.
            data = Data([replace(track, force=force)], [force - rough])
            self._information[each] = information(data, near, TIMING, self._law)
            self._grid_error[each] = float(np.abs(force - rough).max() / np.abs(force).max())
        return self._information[each]

    def _track(self, each: PlannedPresses) -> PressTrack:
        corners, tips = each.path()
        time = np.arange(0.0, corners[-1], 1 / RATE)
        tip = np.stack([np.interp(time, corners, axis) for axis in tips.T], axis=1)
        force = np.random.default_rng(0).normal(0.0, self._noise, tip.shape)
        track = track_of(each.indenter, each.indenter, time, tip, time, force)
        assert track is not None
        return track

    @property
    def _prior(self) -> Array:
        return np.diag(np.array([prior_spread(name) for name in self.names]) ** -2)

    def _expected(self, information: Array) -> Expected:
        return Expected(self.names, np.asarray(np.linalg.inv(information), float))

    def best(
        self,
        candidates: Sequence[PlannedPresses],
        *,
        seconds: float,
        change: float,
        progress: Progress = lambda fraction: None,
    ) -> list[PlannedPresses]:
        """Return presses that narrow the sensor's intervals most in the time given [s].

        One after another, the most narrowing for its time (D-optimal, greedy): a press, or the
        first two of an indenter that is not mounted yet, which takes `change` [s]. All forces of an
        indenter may be off by `PRINT`, so that presses by another one tell more than the same ones
        repeated. Presses that are rough on the grid are left out. `progress` is called with the
        fraction of candidates that is solved.
        """
        _require(candidates, seconds, change)
        for done, each in enumerate(candidates):
            self.information(each)
            progress((done + 1) / len(candidates))
        rough = self.rough(candidates)
        smooth = [each for each in candidates if each not in rough]
        if not smooth:
            raise SceneError(
                f"{', '.join(dict.fromkeys(each.indenter for each in rough))}: forces jump between "
                f"{self._grid} pixels; allowed: indenters without thin edges or tips, a finer grid"
            )
        _require(smooth, seconds, change)
        chosen: list[PlannedPresses] = []
        while True:
            now, mounted = self._robust(chosen).volume, {each.indenter for each in chosen}
            best: tuple[float, list[PlannedPresses]] | None = None
            for more in _steps([each for each in smooth if each not in chosen], mounted):
                then = [*chosen, *more]
                if cost(then, change) > seconds:
                    continue
                gained = now - self._robust(then).volume
                rate = gained / (cost(then, change) - cost(chosen, change))
                if best is None or rate > best[0]:
                    best = rate, more
            if best is None:
                return chosen
            chosen += best[1]

    def rough(self, candidates: Sequence[PlannedPresses]) -> list[PlannedPresses]:
        """Return those whose forces differ too much between two grids to tell slopes."""
        for each in candidates:
            self.information(each)
        most = ROUGH * ROUGH_GRID / self._grid
        return [each for each in candidates if self._grid_error[each] > most]

    def _robust(self, chosen: Sequence[PlannedPresses]) -> Expected:
        """Return the uncertainty if all forces of an indenter have a common error, `PRINT`."""
        information, scale = self._prior, self.names.index("modulus")
        for name in {each.indenter for each in chosen}:
            part = sum(self.information(each) for each in chosen if each.indenter == name)
            assert not isinstance(part, int)
            # Forces are proportional to the modulus, so its slopes are those of the scale.
            lost = np.outer(part[scale], part[scale]) / (PRINT**-2 + part[scale, scale])
            information = information + part - lost
        return self._expected(information)


def _require(candidates: Sequence[PlannedPresses], seconds: float, change: float) -> None:
    """Check that one candidate fits into the time [s]."""
    least = change + min(each.seconds for each in candidates)
    if seconds < least:
        raise SceneError(f"{seconds:g} s: not enough for a press; allowed: at least {least:.0f} s")


def _steps(open_: Sequence[PlannedPresses], mounted: set[str]) -> Iterator[list[PlannedPresses]]:
    for index, each in enumerate(open_):
        yield [each]
        if each.indenter not in mounted:
            yield from ([each, other] for other in open_[:index] if other.indenter == each.indenter)


def cost(chosen: Sequence[PlannedPresses], change: float) -> float:
    """Return the time of presses with `change` for each indenter [s]."""
    mounted = {each.indenter for each in chosen}
    return sum(each.seconds for each in chosen) + change * len(mounted)


def sessions(chosen: Sequence[PlannedPresses]) -> list[PlannedPresses]:
    """Return the chosen presses with those of one indenter, shear and hold in one session each."""
    groups: dict[tuple[str, float, float], list[float]] = {}
    for each in chosen:
        key = each.indenter, each.plan.shear, each.hold
        groups.setdefault(key, []).append(each.plan.depth_max)
    first = list(dict.fromkeys(each.indenter for each in chosen))
    return [
        planned_presses(name, sorted(depths), shear, hold)
        for (name, shear, hold), depths in sorted(
            groups.items(), key=lambda item: (first.index(item[0][0]), item[0])
        )
    ]


def _round(length: float) -> float:
    """Return a length rounded to 0.01 mm."""
    return round(length, 5)
