"""Fit of a twin: the sensor, mount and gauge that explain tracks, with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recorder.processes import several
from recorder.progress import part_of, span_of
from sim.arrays import Array, Progress
from sim.errors import SceneError
from sim.result import ContactTier
from sim.scene import Friction, Viscosity
from sim.sensors import SimulatedSensor
from sim.sensors.posterior import Posterior, interval_of, is_log
from sim.sensors.quantities import POISSON, quantities, with_quantities
from sim.twin.model import STEPS, Linear, TrackForces, TrackModel
from sim.twin.observations import SETTLING, PressTrack

# Prior spreads: of logarithms, but of Poisson's ratio and of quantities in SI as they are. A skin's
# thickness is measured, or known from its mould, better than its modulus.
PRIOR = {
    "modulus": 1.0,
    "thickness": 0.2,
    "poisson": 0.02,
    "friction": 0.7,
    "ratio": 0.8,
    "time": 0.5,
    "height": 50e-6,
    "compliance": 5e-6,
    "turn": 0.03,
    "tilt": 0.0175,
}
# Sensor without friction or viscosity in its row: these are where the fit begins.
FRICTION, VISCOSITY = Friction(0.6), Viscosity((0.15, 0.15), (0.05, 0.5))
# Names of what is not of the sensor.
TILT = ("tilt_x", "tilt_y")
BENCH = ("height", "compliance", "turn_x", "turn_y", "turn_z", *TILT)
# Most rounds of a fit, and the largest step in posterior spreads at which it has converged.
ROUNDS, SMALL = 12, 0.25
# Standard deviations from the middle of an interval of 90 % to its ends.
Z = 1.645
# Least and most timing error between arm and gauge [s], and the least error of the law.
TIMING, LAW = (5e-4, 60e-3), 4e-3
# Relative error that all normal forces of a press have in common, and all its shear forces.
COMMON = 0.01
# Pixels, and elements through the thickness, beside those of the fit: their forces differ by about
# the error of the fit's.
COARSER = 0.7
# Longest step of a logarithm in a round, and the longest after which derivatives are corrected
# rather than taken again, in steps by which they are taken.
STEP, CLOSE = 0.5, 6.0
# Damping beyond which a step is given up.
DAMPED, DAMPED_LITTLE = 100.0, 0.5
# Decrease of the squared residuals that ends a descent.
LITTLE = 0.1
# Cost above the least, from which an explanation is too unlikely to count (its odds are 1 in 90).
UNLIKELY = 9.0
# Thicknesses, over that of an explanation, from which others are looked for.
THICKNESSES = (0.8, 1.25)
# Cost above that of the best explanation, up to which their mean is taken for it.
LITTLE_WORSE = 1.0
# How often tier `fem` corrects the forces of tier `layer`: first at an explanation by `layer`, then
# at one by forces that are corrected there.
CORRECTIONS = 2
# Most explanations that are corrected, since each takes minutes.
EXPLAINED = 2
# Spread over the prior's above which presses do not identify a quantity.
UNIDENTIFIED = 0.7


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Uncertainty of quantities after some presses."""

    names: tuple[str, ...]
    covariance: Array
    """(p, p), of logarithms where `is_log` says so."""

    @property
    def spreads(self) -> dict[str, float]:
        """Standard deviation of each quantity, or of its logarithm."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@dataclass(frozen=True, slots=True, eq=False)
class Identified(Uncertainty):
    """Quantities that presses identify, with or without a gauge."""

    design: SimulatedSensor
    """Sensor from which the fit began, with friction and viscosity."""
    values: Mapping[str, float]
    """All quantities, in SI."""

    def interval(self, name: str, z: float = Z) -> tuple[float, float]:
        """Return the interval of a quantity, 90 % by default."""
        return interval_of(name, self.values[name], z * self.spreads[name])


@dataclass(frozen=True, slots=True, eq=False)
class Fit(Identified):
    """Result of a fit."""

    tracks: tuple[PressTrack, ...]
    readings: tuple[Array, ...]
    """Forces that the twin gives (n, 3) [N], of each track."""
    timing: float
    """Timing error between arm and gauge [s], of forces while the tip moves."""
    latency: float
    """Time by which moving forces are later than the twin's on average [s]."""
    law: float
    """Error of forces at rest that neither noise nor timing explain, over the force."""
    misfit: float
    """RMS difference of forces at rest over their RMS."""
    rounds: int
    tier: ContactTier = "layer"
    """`fem` if its forces corrected those of tier `layer`."""

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Quantities that the presses do not identify, so that they keep their prior's value."""
        spreads = self.spreads
        return tuple(
            name for name in self.names if spreads[name] > UNIDENTIFIED * prior_spread(name)
        )

    @property
    def sensor(self) -> SimulatedSensor:
        """The twin: the design with the fitted quantities and their posterior."""
        of_design = quantities(self.design)
        rows = [index for index, name in enumerate(self.names) if name in of_design]
        twin = with_quantities(self.design, {name: self.values[name] for name in of_design})
        names, covariance = [self.names[row] for row in rows], self.covariance[np.ix_(rows, rows)]
        height = float(self.values["height"])
        posterior = Posterior.of(names, covariance, self.tier, height, self.law)
        return replace(twin, posterior=posterior)

    def distance(self, name: str, value: float) -> float:
        """Return the distance from a value to that of a quantity, in its standard deviations."""
        return way_of(name, {name: value}, self.values) / self.spreads[name]


def prior_spread(name: str) -> float:
    """Return the prior's standard deviation of a quantity, or of its logarithm."""
    return PRIOR[name.partition("_")[0]]


def fitted(
    tracks: Sequence[PressTrack],
    design: SimulatedSensor,
    *,
    grid: int = 96,
    tier: ContactTier = "layer",
    device: str = "cpu",
    processes: int = 1,
    progress: Progress = lambda fraction: None,
) -> Fit:
    """Return the twin that explains tracks of one sensor, however badly: see its `misfit`.

    The fit begins from the row `design`, whose body gives the prior's centre; `grid` are pixels
    along the longer side. Tier `layer` takes strains as small; `fem` corrects its forces, in
    minutes. The result does not depend on the number of processes.

    Raises:
        SceneError: There is no track, or a tip goes deeper than the skin is thick.
        SimulationDiverged: The contact of a candidate did not converge, or there is no solution by
            tier `fem`.
    """
    design = with_effects(design)
    deepest = max((-track.tip[:, 2].min() for track in tracks), default=0.0)
    if not 0 < deepest < design.body.thickness:
        raise SceneError(
            f"tracks: {1e3 * deepest:.3g} mm deep; allowed: presses, less deep than the skin of "
            f"{design.name}, {1e3 * design.body.thickness:.3g} mm"
        )
    for track in tracks:
        if not (track.rest & track.contact).any():
            raise SceneError(
                f"{track.name}: the tip never stands still in contact; allowed: presses with holds "
                "(hold_ms in the bench file)"
            )
    with several(processes) as workers:
        model, rougher = (
            TrackModel(design, tracks, grid=pixels, workers=workers)
            for pixels in (grid, round(COARSER * grid))
        )

        def correct(values: Mapping[str, float]) -> None:
            for each, finer in ((model, 1.0), (rougher, COARSER)):
                each.correct(values, finer, device)

        by_fem = correct if tier == "fem" else None
        return _fit(design, tracks, model, rougher, by_fem, progress)


def _fit(
    design: SimulatedSensor,
    tracks: Sequence[PressTrack],
    model: TrackModel,
    rougher: TrackModel,
    correct: Callable[[Mapping[str, float]], None] | None,
    progress: Progress,
) -> Fit:
    """Return the fit by a model of tier `layer`, whose error is its distance from a rougher one.

    `correct` corrects both at some values; without it they stay as they are.
    """
    part = 1.0 if correct is None else 0.4
    names = (*quantities(design), *BENCH)
    centre = {**quantities(design), **dict.fromkeys(BENCH, 0.0)}

    def problem_at(values: Mapping[str, float]) -> FitProblem:
        fine, coarse = model.readings(values), rougher.readings(values)
        data = Data(tracks, [one - other for one, other in zip(fine, coarse, strict=True)])
        return FitProblem(data, model, names, centre)

    stiffer = _stiffer(tracks, model.readings(centre))
    values: Mapping[str, float] = {**centre, "modulus": stiffer * centre["modulus"]}
    problem = problem_at(values)
    level = _descended(problem.without(*TILT), values, span_of(progress, 0.0, 0.2 * part))
    # A level pad is one explanation, a tilted one another, with a skin that may be quite different:
    # a descent from the one need not find the other.
    values, near, rounds = _tilted(problem, level), None, level.rounds
    for begun in (0.2, 0.4):
        # The grid's error depends on the tilt.
        problem = problem_at(values)
        further = span_of(progress, part * begun, 0.2 * part)
        tilted = _descended(problem, values, further, near)
        values, near, rounds = tilted.values, tilted.near, rounds + tilted.rounds
    ends = [level.values, tilted.values]
    further = span_of(progress, 0.6 * part, 0.4 * part)
    for descent in _other_thicknesses(problem, tilted.values, further):
        rounds += descent.rounds
        ends.append(descent.values)
    timing, law, sigma = _weights(tracks, tilted.near)
    explanations = _explanations(problem, ends, sigma)
    for done in range(CORRECTIONS if correct is not None else 0):
        assert correct is not None
        progress(part + 0.3 * done)
        correct(explanations[0].values)
        problem = problem_at(explanations[0].values)
        likely = explanations[:EXPLAINED]
        further = span_of(progress, part + 0.3 * done + 0.1, 0.2 / len(likely))
        again = [_descended(problem, each.values, further) for each in likely]
        rounds += sum(each.rounds for each in again)
        timing, law, sigma = _weights(tracks, again[0].near)
        ends = [each.values for each in again]
        explanations = _explanations(problem, ends, sigma)
    explanations = _with_mean(problem, explanations, sigma)
    best = explanations[0]
    progress(1.0)
    return Fit(
        design=design,
        names=names,
        values=best.values,
        covariance=_mixed(names, explanations),
        tracks=tuple(tracks),
        readings=tuple(best.near.readings),
        timing=timing,
        latency=_latency(tracks, model.solve(best.values)),
        law=law,
        misfit=misfit(tracks, best.near.readings),
        rounds=rounds,
        tier="layer" if correct is None else "fem",
    )


def _other_thicknesses(
    problem: FitProblem, values: Mapping[str, float], progress: Progress
) -> Iterator[Descended]:
    """Yield descents that begin with a thinner and a thicker skin than that of some values.

    A thinner skin that is softer, with another Poisson's ratio, explains presses nearly as well: a
    descent ends anywhere in that valley, and the derivatives there do not show how long it is.
    """
    others = problem.without("thickness")
    for number, factor in enumerate(THICKNESSES):
        moved = {**values, "thickness": factor * values["thickness"]}
        first, second = (
            part_of(progress, 2 * number + each, 2 * len(THICKNESSES)) for each in (0, 1)
        )
        held = _descended(others, moved, first)
        freed = _descended(problem, held.values, second)
        yield replace(freed, rounds=held.rounds + freed.rounds)


@dataclass(frozen=True, slots=True, eq=False)
class Data:
    """Tracks, and the error that the grid's size makes of their readings."""

    tracks: Sequence[PressTrack]
    grid_errors: Sequence[Array]
    """Of each track (n, 3) [N]."""


@dataclass(frozen=True, slots=True, eq=False)
class FitProblem:
    """Tracks to explain by the quantities of a model."""

    data: Data
    model: TrackModel
    names: tuple[str, ...]
    """Quantities that may change (p)."""
    centre: Mapping[str, float]
    """Centre of the prior, of all quantities."""

    @property
    def prior(self) -> Array:
        """The prior's spreads (p,)."""
        return np.array([prior_spread(name) for name in self.names])

    def without(self, *held: str) -> FitProblem:
        """Return the problem with some quantities held."""
        return replace(self, names=tuple(name for name in self.names if name not in held))

    def offset(self, values: Mapping[str, float]) -> Array:
        """Return the distance of values from the prior's centre (p,)."""
        return ways_of(self.names, self.centre, values)


@dataclass(frozen=True, slots=True, eq=False)
class Descended:
    """Values at which a descent ended, and the readings there."""

    values: Mapping[str, float]
    near: Linear
    rounds: int


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """Values that explain the tracks, and how well."""

    values: Mapping[str, float]
    near: Linear
    cost: float
    """Squared residuals, and squared distances from the prior's centre."""
    covariance: Array
    """(p, p)."""


def _explanations(
    problem: FitProblem, ends: Sequence[Mapping[str, float]], sigma: Sequence[Array]
) -> list[Explanation]:
    """Return the ends of descents, the best first, without those that are worse or the same.

    Their covariances come from derivatives taken where they are: those that a descent corrected on
    its way can be off by enough to make intervals two to three times too narrow.
    """
    data, model, names, prior = problem.data, problem.model, problem.names, problem.prior
    offsets = [problem.offset(values) / prior for values in ends]
    residuals = [_stacked(data, model.readings(values), sigma)[0] for values in ends]
    costs = [_cost(*each) for each in zip(residuals, offsets, strict=True)]
    explanations: list[Explanation] = []
    for index in np.argsort(costs):
        repeated = any(_alike(names, each, ends[index]) for each in explanations)
        if repeated or costs[index] > min(costs) + UNLIKELY:
            continue
        near = model.linearised(ends[index], names)
        residual, jacobian = _stacked(data, near.readings, sigma, near.slopes)
        excess = max(1.0, float(residual @ residual) / max(1, len(residual) - len(names)))
        inverse = jacobian.T @ jacobian / excess + np.diag(prior**-2)
        covariance = np.asarray(np.linalg.inv(inverse), float)
        explanations.append(Explanation(ends[index], near, costs[index], covariance))
    return explanations


def _alike(names: Sequence[str], one: Explanation, values: Mapping[str, float]) -> bool:
    """True if values are within a small part of the spread of an explanation."""
    way = ways_of(names, one.values, values)
    return float(way @ np.linalg.solve(one.covariance, way)) < SMALL**2


def _with_mean(
    problem: FitProblem, explanations: list[Explanation], sigma: Sequence[Array]
) -> list[Explanation]:
    """Return explanations after their mean, which errs less than the best, if it explains as well.

    It does not where the valley between them bends.
    """
    if len(explanations) < 2:
        return explanations
    best, names = explanations[0], problem.names
    ways = np.array([ways_of(names, best.values, each.values) for each in explanations])
    values = moved_along(names, best.values, _odds(explanations) @ ways)
    (mean,) = _explanations(problem, [values], sigma)
    return [mean, *explanations] if mean.cost < best.cost + LITTLE_WORSE else explanations


def ways_of(names: Sequence[str], one: Mapping[str, float], other: Mapping[str, float]) -> Array:
    """Return `way_of` from one's values to the other's (p,)."""
    return np.array([way_of(name, one, other) for name in names])


def _odds(explanations: Sequence[Explanation]) -> Array:
    """Return the probability of each explanation, by its cost."""
    costs = np.array([each.cost for each in explanations])
    weights = np.exp((costs.min() - costs) / 2)
    return np.asarray(weights / weights.sum())


def _mixed(names: Sequence[str], explanations: Sequence[Explanation]) -> Array:
    """Return the covariance (p, p) about the first explanation, each as likely as its cost says."""
    ways = [ways_of(names, explanations[0].values, each.values) for each in explanations]
    mixed = np.zeros_like(explanations[0].covariance)
    for weight, each, way in zip(_odds(explanations), explanations, ways, strict=True):
        mixed += weight * (each.covariance + np.outer(way, way))
    return mixed


def _tilted(problem: FitProblem, level: Descended) -> Mapping[str, float]:
    """Return the values of a level pad, tilted to the side that explains the tracks best."""
    data, model = problem.data, problem.model
    _, _, sigma = _weights(data.tracks, level.near)
    leaning = [
        {**level.values, "tilt_x": x * PRIOR["tilt"] / 2, "tilt_y": y * PRIOR["tilt"] / 2}
        for x in (-1, 1)
        for y in (-1, 1)
    ]

    def missed(values: Mapping[str, float]) -> float:
        residual, _ = _stacked(data, model.readings(values), sigma)
        return float(residual @ residual)

    model.prepare(leaning)
    return min(leaning, key=missed)


def _descended(
    problem: FitProblem,
    values: Mapping[str, float],
    progress: Progress,
    previous: Linear | None = None,
) -> Descended:
    """Return where the free quantities explain the tracks best, from `previous` at `values`."""
    data, model, names, prior = problem.data, problem.model, problem.names, problem.prior
    values, damping = dict(values), 1e-3
    near, reused = model.linearised(values, names, previous), previous is not None
    for done in range(1, ROUNDS + 1):
        progress((done - 1) / ROUNDS)
        _, _, sigma = _weights(data.tracks, near)
        residual, jacobian = _stacked(data, near.readings, sigma, near.slopes)
        offset = problem.offset(values)
        normal = jacobian.T @ jacobian + np.diag(prior**-2)
        slope = jacobian.T @ residual - offset / prior**2
        cost = _cost(residual, offset / prior)
        spread = np.sqrt(np.diag(np.linalg.inv(normal)))
        while True:
            step = _step(names, values, normal + damping * np.diag(np.diag(normal)), slope)
            longest = max(abs(each) for name, each in zip(names, step, strict=True) if is_log(name))
            step *= min(1.0, STEP / longest)
            moved = moved_along(names, values, step)
            trial, _ = _stacked(data, model.readings(moved), sigma)
            gained = cost - _cost(trial, problem.offset(moved) / prior)
            better = gained > 0
            if better or damping > DAMPED:
                break
            damping = max(damping, 1e-2) * 10
        # A damped step is short wherever it is.
        small = damping < DAMPED_LITTLE and float(np.max(np.abs(step) / spread)) < SMALL
        if better:
            way = {name: way_of(name, values, moved) for name in names}
            values, damping = moved, damping / 10
            reused = all(abs(way.get(name, 0.0)) < CLOSE * step for name, step in STEPS.items())
            if reused:
                near = model.followed(values, names, near, way)
            else:
                near = model.linearised(values, names)
        if small or 0 < gained < LITTLE or (not better and not reused):
            break
        if not better:
            # Derivatives from elsewhere may be why: take new ones before giving up.
            reused, damping = False, 1e-2
            near = model.linearised(values, names)
    return Descended(values, near, done)


def _step(names: Sequence[str], values: Mapping[str, float], normal: Array, slope: Array) -> Array:
    """Return the step (p,) to where `normal` step = `slope`; at a bound none leads beyond it."""
    step = np.asarray(np.linalg.solve(normal, slope), float)
    free = np.array(
        [name != "compliance" or values[name] > 0 or step[k] >= 0 for k, name in enumerate(names)]
    )
    if not free.all():
        step[~free] = 0.0
        step[free] = np.linalg.solve(normal[np.ix_(free, free)], slope[free])
    return step


def information(data: Data, near: Linear, timing: float, law: float) -> Array:
    """Return the information of tracks on the quantities (p, p): an inverse covariance, no prior.

    `near` are readings and slopes of all tracks; `timing` is the error between arm and gauge [s],
    `law` the relative error of the law at rest.
    """
    sigma = _sigmas(data.tracks, near, timing, law)
    _, jacobian = _stacked(data, near.readings, sigma, near.slopes)
    return np.asarray(jacobian.T @ jacobian)


def with_effects(design: SimulatedSensor) -> SimulatedSensor:
    """Return a design with friction and viscosity, where it has none those that a fit begins at."""
    effects = design.effects
    return replace(
        design,
        posterior=None,
        effects=replace(
            effects, friction=effects.friction or FRICTION, viscosity=effects.viscosity or VISCOSITY
        ),
    )


def misfit(tracks: Sequence[PressTrack], readings: Sequence[Array]) -> float:
    """Return the RMS difference of forces at rest over their RMS."""
    off = force = 0.0
    for track, read in zip(tracks, readings, strict=True):
        rest = track.rest & track.contact
        off += float(np.square(track.force - read)[rest].sum())
        force += float(np.square(track.force)[rest].sum())
    return math.sqrt(off / force) if force > 0 else math.inf


def _stiffer(tracks: Sequence[PressTrack], readings: Sequence[Array]) -> float:
    """Return the factor that brings readings to the forces, least squares."""
    product = sum(float(np.sum(t.force * read)) for t, read in zip(tracks, readings, strict=True))
    square = sum(float(np.sum(read * read)) for read in readings)
    return max(product / square, 1e-3) if square > 0 else 1.0


def _errors(
    tracks: Sequence[PressTrack], readings: Sequence[Array], rates: Sequence[Array]
) -> tuple[float, float]:
    """Return the timing error [s] of moving points, and the relative error of those at rest."""
    late, off = [], []
    for track, read, rate in zip(tracks, readings, rates, strict=True):
        error = np.linalg.norm(track.force - read, axis=1) / math.sqrt(3)
        size = np.linalg.norm(track.force, axis=1)
        fast = recent(track.time, rate)
        moving = track.contact & ~track.rest & (fast > 0.1 * fast.max(initial=0))
        late.append(error[moving] / fast[moving])
        still = track.contact & track.rest & (size > 0.2 * size.max(initial=0))
        square = np.square(error[still]) - np.square(track.noise[still])
        off.append(square / np.square(size[still]))
    timing = math.sqrt(3) * float(np.sqrt(np.mean(np.square(np.concatenate(late)))))
    law = math.sqrt(max(0.0, float(np.mean(np.concatenate(off)))))
    return float(np.clip(np.nan_to_num(timing), *TIMING)), max(LAW, float(np.nan_to_num(law)))


def _latency(tracks: Sequence[PressTrack], solved: Sequence[TrackForces]) -> float:
    """Return the delay that moves the twin's forces nearest to those of the moving points [s]."""
    product = square = 0.0
    for track, each in zip(tracks, solved, strict=True):
        moving = track.contact & ~track.rest
        rate = each.rate[moving]
        product -= float(np.sum((track.force - each.force)[moving] * rate))
        square += float(np.sum(rate * rate))
    return product / square if square > 0 else 0.0


def recent(time: Array, rate: Array) -> Array:
    """Return the largest rate (n,) of each point and of those up to `SETTLING` before it."""
    first = np.searchsorted(time, time - SETTLING)
    return np.array([rate[low : row + 1].max() for row, low in enumerate(first)])


def _weights(tracks: Sequence[PressTrack], near: Linear) -> tuple[float, float, list[Array]]:
    """Return timing error [s], relative error at rest, and the error expected of each point [N]."""
    timing, law = _errors(tracks, near.readings, near.rates)
    return timing, law, _sigmas(tracks, near, timing, law)


def _sigmas(tracks: Sequence[PressTrack], near: Linear, timing: float, law: float) -> list[Array]:
    """Return the error expected of each point (n,) [N].

    Points of one rest have one error of the law, so theirs counts as often as there are points.
    """
    sigmas = []
    for track, read, rate in zip(tracks, near.readings, near.rates, strict=True):
        rest = track.rest
        episode = _episodes(rest)
        count = np.bincount(episode, rest)[episode]
        often = np.where(rest, np.maximum(count, 1), 1)
        size = np.linalg.norm(read, axis=1)
        late = timing * recent(track.time, rate)
        sigmas.append(np.sqrt(track.noise**2 + late**2 + often * (law * size) ** 2))
    return sigmas


def _episodes(rest: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of the rest that each point (n,) belongs to, or comes after."""
    return np.cumsum(np.diff(np.r_[False, rest].astype(int)) > 0)


def _stacked(
    data: Data, readings: Sequence[Array], sigma: Sequence[Array], slopes: Sequence[Array] = ()
) -> tuple[Array, Array]:
    """Return residuals (m,) in standard errors of the resting points, and slopes (m, p).

    Normal forces of a press have a common relative error, that of the law and the grid, and so
    have its shear forces: law and grid are wrong alike in all of a press. Those of a rest have
    another, for the grid's error changes as the tip is dragged. Forces of a moving tip
    differ by how late each stream is read, all in the same direction: they would pass for
    relaxation.
    """
    parts, columns = [], []
    for index, (track, off, read, each) in enumerate(
        zip(data.tracks, data.grid_errors, readings, sigma, strict=True)
    ):
        used = track.contact & track.rest
        episode = _episodes(track.rest)[used]
        common = _common(track.force[used], track.target[used], episode, off[used])
        common /= each[used, None, None]
        rows = [(track.force - read)[used, :, None]]
        if slopes:
            rows.append(slopes[index][used])
        scaled = np.concatenate([row / each[used, None, None] for row in rows], axis=-1)
        white = _whitened(*(each.reshape(-1, each.shape[-1]) for each in (scaled, common)))
        parts.append(white[:, 0])
        columns.append(white[:, 1:])
    return np.concatenate(parts), np.concatenate(columns)


def _common(force: Array, target: NDArray[np.int64], rest: NDArray[np.int64], off: Array) -> Array:
    """Return the errors that points have in common (m, 3, k) [N], each of one standard deviation.

    Forces and the errors of the grid are (m, 3) [N]; each point (m,) has a press and a rest.
    """
    errors = []
    for press in np.unique(target):
        of_press = target == press
        for axes in ([0, 1], [2]):
            of_all = _part(force, off, of_press, axes)
            rests = np.unique(rest[of_press])
            # A dragged tip's edges lie elsewhere in their pixels in each rest. A rest counts by its
            # force: without shear the part of it that is off says nothing.
            each = [of_press & (rest == one) for one in rests]
            apart = [_part(force, off, rows, axes) - of_all for rows in each]
            weights = [float(np.sum(np.square(force[rows][:, axes]))) for rows in each]
            changing = 0.0
            if any(weights):
                changing = math.sqrt(np.average(np.square(apart), weights=weights))
            for rows, size in (
                (of_press, math.hypot(COMMON, of_all)),
                *((rows, changing) for rows in each if len(rests) > 1),
            ):
                error = np.zeros_like(force)
                error[np.ix_(rows, axes)] = size * force[rows][:, axes]
                errors.append(error)
    return np.stack(errors, axis=-1)


def _part(force: Array, off: Array, rows: NDArray[np.bool_], axes: list[int]) -> float:
    """Return the part of the force of some points that is off, by least squares."""
    one, other = force[rows][:, axes], off[rows][:, axes]
    square = float(np.sum(one * one))
    return float(np.sum(one * other)) / square if square > 0 else 0.0


def _whitened(values: Array, common: Array) -> Array:
    """Return C^-1/2 `values` (m, p), where C = 1 + `common` `common`^T, (m, k)."""
    basis, spread, _ = np.linalg.svd(common, full_matrices=False)
    lost = 1 - 1 / np.sqrt(1 + spread**2)
    return np.asarray(values - basis @ (lost[:, None] * (basis.T @ values)))


def _cost(residual: Array, offset: Array) -> float:
    return float(residual @ residual + offset @ offset)


def _coordinate(name: str, values: Mapping[str, float]) -> float:
    return math.log(values[name]) if is_log(name) else values[name]


def way_of(name: str, values: Mapping[str, float], moved: Mapping[str, float]) -> float:
    """Return the way of a quantity, or of its logarithm, from some values to others."""
    return _coordinate(name, moved) - _coordinate(name, values)


def moved_along(names: Sequence[str], values: Mapping[str, float], step: Array) -> dict[str, float]:
    """Return values after a step (p,) of some quantities, each as in `moved_by`."""
    steps = zip(names, step, strict=True)
    return {**values, **{name: moved_by(name, values, by) for name, by in steps}}


def moved_by(name: str, values: Mapping[str, float], step: float) -> float:
    """Return a quantity after a step, of its logarithm if it has one, within its bounds."""
    if is_log(name):
        return values[name] * math.exp(step)
    moved = values[name] + step
    if name == "poisson":
        return float(np.clip(moved, *POISSON))
    return max(moved, 0.0) if name == "compliance" else moved
