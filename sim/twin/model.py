"""Forces of a candidate sensor along tracks, and their derivatives.

They are those of tier `layer`, as they are or corrected by tier `fem`: by the ratio of both for one
candidate (space mapping; Bandler et al., IEEE Trans. Microw. Theory Tech. 42 (1994) 2536, of the
output).
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from recorder.processes import Workers, results
from sim.arrays import Array
from sim.errors import PassesThrough, SimulationDiverged
from sim.fem import FOR_EDGES, Fem, further_settings
from sim.indenters import Indenter, named
from sim.scene import Motion
from sim.sensors import SimulatedSensor, SurfaceField
from sim.sensors.posterior import is_log
from sim.sensors.quantities import quantities, with_quantities
from sim.stream import LivePress
from sim.tiers import simulate
from sim.twin.observations import PressTrack

Key = tuple[tuple[str, float], ...]

# Steps of the derivatives that need another solution: relative, but of these as they are. Forces of
# a dragged edge on a grid jump by up to 5 %, and short steps would take the jumps for slopes.
STEPS = {
    "thickness": 0.06,
    "friction": 0.06,
    "poisson": 0.01,
    "height": 15e-6,
    "tilt_x": 5e-3,
    "tilt_y": 5e-3,
}
# Forces have a kink where nothing leans: an edge is lowest whichever way a flat face leans.
ONE_SIDED = ("tilt_x", "tilt_y")
# Tier `fem`, where it corrects forces of tier `layer`: elements through the thickness, the highest
# [m], steps over the thickness, and tolerances. With 4 elements four presses took 91 s of a core.
CELLS, HIGHEST, STEPS_OF_THICKNESS = 4.5, 1.2e-3, 20
FEM = Fem(grading=FOR_EDGES, augmentations=1, tolerance=1e-3, path_tolerance=1e-2)
# Force over the largest of a track from which ratios of forces are taken.
SIGNIFICANT = 0.05
# Residual of the contact.
TOLERANCE = 5e-3
# Width of an indenter without sides, such as a cone [m].
WIDTH = 7e-3
# Step of the logarithm of a relaxation time.
STEP_TIME = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class TrackForces:
    """Solution along one track, in the contact frame."""

    force: Array
    """Force on the sensor (n, 3) [N]."""
    elastic: Array
    """Force after full relaxation at the same displacement (n, 3) [N]."""
    rate: Array
    """Rate of the force (n, 3) [N/s]."""


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Readings of a candidate and their first derivatives, of every track."""

    readings: list[Array]
    """Forces (n, 3) [N]."""
    slopes: list[Array]
    """Derivatives (n, 3, p): by logarithms of modulus, thickness, friction, ratios and times, and
    by the others themselves."""
    rates: list[Array]
    """Rates of the force (n,) [N/s]."""
    costly: dict[str, list[Array]]
    """Those derivatives that took a solution each, by name."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """Candidate sensor along one track, as a worker process gets it."""

    sensor: SimulatedSensor
    upright: Indenter
    track: PressTrack
    values: Mapping[str, float]
    grid: int

    def in_pad_frame(self) -> tuple[Indenter, Array]:
        """Return the indenter and its tips (n, 3) [m] in the frame of the candidate's pad."""
        values, track = self.values, self.track
        tilt = values.get("tilt_x", 0.0), values.get("tilt_y", 0.0)
        indenter, tip = leaning(self.upright, track.tip, tilt)
        tip[:, 2] -= values.get("height", 0.0)
        tip[:, 2] -= values.get("compliance", 0.0) * np.minimum(track.force[:, 2], 0.0)
        return indenter, tip

    def pressed(self) -> Iterator[LivePress]:
        """Yield the press at each point of the track; it is the same object each time."""
        track = self.track
        indenter, tip = self.in_pad_frame()
        press = LivePress(self.sensor, indenter, grid=self.grid, tolerance=TOLERANCE)
        before = track.time[0]
        for time, position in zip(track.time, tip, strict=True):
            press.move(position, time - before)
            before = time
            yield press

    def solved(self) -> TrackForces:
        """Return the solution along the track."""
        count = len(self.track.time)
        force, elastic = np.zeros((count, 3)), np.zeros((count, 3))
        for row, press in enumerate(self.pressed()):
            if press.touching:
                force[row], elastic[row] = press.force, press.relaxed_force
        return TrackForces(force, elastic, _rates(self.track.time, force))

    def by_fem(self, finer: float, device: str) -> Array:
        """Return the force at each point of the track by tier `fem` (n, 3) [N]."""
        time = self.track.time - self.track.time[0]
        return by_fem(self.sensor, *self.in_pad_frame(), time, finer, device)


def by_fem(
    sensor: SimulatedSensor,
    indenter: Indenter,
    tip: Array,
    time: Array,
    finer: float = 1.0,
    device: str = "cpu",
) -> Array:
    """Return the force on a sensor along a path (n, 3) [N], by tier `fem`.

    Tips (n, 3) [m], z above the undeformed surface there, are at times (n,) [s] from 0 on; `finer`
    are elements through the thickness, over `CELLS`. Presses that diverge are tried again with
    smaller steps, or on smaller elements if the indenter passes through them.
    """
    scene, first = sensor.scene(indenter, motion_of(tip, time)), fem_of(sensor, finer)
    try:
        result = simulate(scene, first, device=device)
    except SimulationDiverged as diverged:
        diverged.forget_dump()
        passes = isinstance(diverged, PassesThrough)
        further = further_settings(first, sensor.body)
        (second,) = (fem for _, fem, of_passing in further if of_passing == passes)
        result = simulate(scene, second, device=device)
    return np.asarray(result.wrench[:, :3], float)


def motion_of(tip: Array, time: Array) -> Motion:
    """Return the motion of tips (n, 3) [m] at times (n,) [s]."""
    return Motion(tuple(map(tuple, tip.tolist())), tuple(time.tolist()))


def fem_of(sensor: SimulatedSensor, finer: float = 1.0) -> Fem:
    """Return the settings of tier `fem` for a sensor; `finer` as in `by_fem`."""
    thickness = sensor.body.thickness
    spacing = min(thickness / CELLS, HIGHEST) / finer
    return replace(FEM, spacing=spacing, step_travel=thickness / STEPS_OF_THICKNESS)


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Map from forces of tier `layer` to true ones along a track."""

    ratio: Array
    """True forces over those of tier `layer`, of Fz and of the shear's size (n, 3)."""
    rest: Array
    """Difference that ratios leave, over the modulus (n, 3) [N/Pa]."""

    @classmethod
    def of(cls, true: Array, layer: Array, modulus: float) -> Self:
        """Return the map between forces (n, 3) [N] of a sensor of some modulus [Pa]."""
        normal = _ratio(np.abs(true[:, 2]), np.abs(layer[:, 2]), np.ones(len(true)))
        shears = np.linalg.norm(true[:, :2], axis=1), np.linalg.norm(layer[:, :2], axis=1)
        shear = _ratio(*shears, normal)
        ratio = np.stack([shear, shear, normal], axis=1)
        return cls(ratio, (true - ratio * layer) / modulus)

    def applied(self, layer: Array, modulus: float) -> Array:
        """Return true forces (n, 3) [N] for those of tier `layer`."""
        return np.asarray(self.ratio * layer + modulus * self.rest)


class TrackModel:
    """Readings that a sensor would give along tracks.

    Its quantities are unknown; the design must have friction and viscosity. Workers solve, each a
    track, or this process.
    """

    def __init__(
        self,
        design: SimulatedSensor,
        tracks: Sequence[PressTrack],
        *,
        grid: int = 96,
        workers: Workers | None = None,
    ) -> None:
        self._design = replace(design, trajectory=None, force_depth=None)
        self._tracks = tracks
        self._grid = grid
        self._workers = workers
        self._solved: dict[Key, list[TrackForces]] = {}
        self._corrections: list[Correction] = []

    def readings(self, values: Mapping[str, float]) -> list[Array]:
        """Return the force that the gauge reads at each point (n, 3) [N], of every track."""
        return [self._read(solved, values) for solved in self.solve(values)]

    def correct(self, values: Mapping[str, float], finer: float = 1.0, device: str = "cpu") -> None:
        """Take the forces of tier `fem` at `values` as true, there and nearby.

        Its mesh has `CELLS` elements through the thickness, or `finer` times as many.

        Raises:
            SimulationDiverged: A track has no solution.
        """
        due = [(self._candidate(values, track), finer, device) for track in self._tracks]
        forces = list(results(self._workers, Candidate.by_fem, due))
        self._corrections = []
        self._corrections = [
            Correction.of(force, layer.force, values["modulus"])
            for force, layer in zip(forces, self.solve(values), strict=True)
        ]

    def linearised(
        self, values: Mapping[str, float], names: Sequence[str], previous: Linear | None = None
    ) -> Linear:
        """Return the readings near `values`, which must have all `names`.

        Derivatives by modulus, branches and gauge come from one solution: forces are
        proportional to the modulus, and relaxation is a convolution of the elastic force. The
        contact is assumed not to change with them; readings themselves are exact. The others take
        a solution each, unless they are those of `previous`, not far from here.
        """
        costly: dict[str, list[Array]] = {} if previous is None else dict(previous.costly)
        due = [name for name in STEPS if name not in costly and (name in names or name == "height")]
        ahead = {name: self._moved(values, name, STEPS[name]) for name in due}
        behind = {
            name: self._moved(values, name, -STEPS[name]) for name in due if name in ONE_SIDED
        }
        self.prepare([values, *ahead.values(), *behind.values()])
        base = self.readings(values)
        for name in due:
            step = STEPS[name]
            over = math.log1p(step) if is_log(name) else step
            there = self.readings(ahead[name])
            if name in behind:
                other = self.readings(behind[name])
                if self._off(other) < self._off(there):
                    there, over = other, -step
            costly[name] = [(new - old) / over for new, old in zip(there, base, strict=True)]
        return self._linear(values, names, costly)

    def followed(
        self,
        values: Mapping[str, float],
        names: Sequence[str],
        near: Linear,
        moved: Mapping[str, float],
    ) -> Linear:
        """Return the readings near `values`, with derivatives of `near` corrected by the way there.

        Broyden's update (Math. Comp. 19 (1965) 577) of the costly ones: by `moved`, the way from
        `near`, derivatives predict the change of the readings. Ways shorter than the steps by
        which derivatives are taken correct less, for the solutions are no more exact than that.
        """
        base = self.readings(values)
        steps = {name: moved.get(name, 0.0) for name in near.costly}
        way = {name: step / STEPS[name] ** 2 for name, step in steps.items()}
        square = 1.0 + sum(steps[name] * way[name] for name in steps)
        along = np.array([moved.get(name, 0.0) for name in names])
        missed = [
            new - old - slopes @ along
            for new, old, slopes in zip(base, near.readings, near.slopes, strict=True)
        ]
        costly = {
            name: [
                slope + (way[name] / square) * each
                for slope, each in zip(near.costly[name], missed, strict=True)
            ]
            for name in near.costly
        }
        return self._linear(values, names, costly)

    def _linear(
        self, values: Mapping[str, float], names: Sequence[str], costly: dict[str, list[Array]]
    ) -> Linear:
        solved = self.solve(values)
        base = [self._read(each, values) for each in solved]
        slopes = []
        for index, track in enumerate(self._tracks):
            rows = []
            for name in names:
                if name in costly:
                    rows.append(costly[name][index])
                elif name == "compliance":
                    # The mount yields by compliance times force, as if the surface were lower.
                    rows.append(costly["height"][index] * solved[index].force[:, 2:])
                else:
                    rows.append(self._cheap(name, solved[index], base[index], values, track))
            slopes.append(np.stack(rows, axis=-1))
        rates = [np.linalg.norm(each.rate, axis=1) for each in solved]
        return Linear(base, slopes, rates, costly)

    def _off(self, readings: Sequence[Array]) -> float:
        pairs = zip(self._tracks, readings, strict=True)
        return sum(float(np.square(track.force - read)[track.rest].sum()) for track, read in pairs)

    def solve(self, values: Mapping[str, float]) -> list[TrackForces]:
        """Return the solution of every track."""
        self.prepare([values])
        solved = self._solved[_key(values)]
        if not self._corrections:
            return solved
        return [
            replace(each, force=own.applied(each.force, values["modulus"]))
            for each, own in zip(solved, self._corrections, strict=True)
        ]

    def prepare(self, candidates: Sequence[Mapping[str, float]]) -> None:
        """Solve candidates that are not solved yet, all tracks of all of them side by side."""
        new = {_key(values): values for values in candidates if _key(values) not in self._solved}
        due = [(self._candidate(each, track),) for each in new.values() for track in self._tracks]
        solved, count = list(results(self._workers, Candidate.solved, due)), len(self._tracks)
        for number, key in enumerate(new):
            self._solved[key] = solved[count * number : count * (number + 1)]

    def _candidate(self, values: Mapping[str, float], track: PressTrack) -> Candidate:
        known = quantities(self._design)
        of_design = {name: value for name, value in values.items() if name in known}
        sensor = with_quantities(self._design, of_design)
        return Candidate(sensor, named(track.indenter), track, values, self._grid)

    def surfaces(
        self, values: Mapping[str, float], rows: Sequence[NDArray[np.int64]]
    ) -> list[SurfaceField]:
        """Return the displacement of the top at some points of every track, as one field each."""
        surfaces = []
        for track, points in zip(self._tracks, rows, strict=True):
            shapes = {
                row: press.field
                for row, press in enumerate(self._candidate(values, track).pressed())
                if row in points
            }
            fields = [shapes[int(row)] for row in points]
            surfaces.append(
                replace(
                    fields[0], displacement=np.concatenate([each.displacement for each in fields])
                )
            )
        return surfaces

    @staticmethod
    def _moved(values: Mapping[str, float], name: str, step: float) -> dict[str, float]:
        moved = values[name] * (1 + step) if is_log(name) else values[name] + step
        return {**values, name: moved}

    def _read(self, solved: TrackForces, values: Mapping[str, float]) -> Array:
        turn = np.array([values.get(f"turn_{axis}", 0.0) for axis in "xyz"])
        return np.asarray(solved.force + np.cross(turn, solved.force))

    def _cheap(
        self,
        name: str,
        solved: TrackForces,
        read: Array,
        values: Mapping[str, float],
        track: PressTrack,
    ) -> Array:
        if name == "modulus":
            return read
        kind, _, which = name.partition("_")
        if kind == "turn":
            axis = np.zeros(3)
            axis["xyz".index(which)] = 1.0
            return np.cross(axis, solved.force)
        ratio, time = values[f"ratio_{which}"], values[f"time_{which}"]
        if kind == "ratio":
            return ratio * relaxing(track.time, solved.elastic, time)
        ahead, behind = (
            relaxing(track.time, solved.elastic, time * math.exp(step))
            for step in (STEP_TIME, -STEP_TIME)
        )
        return ratio * (ahead - behind) / (2 * STEP_TIME)


def _ratio(true: Array, layer: Array, otherwise: Array) -> Array:
    """Return the ratio of forces (n,) where they are large enough for one."""
    significant = layer > SIGNIFICANT * layer.max(initial=0.0)
    return np.where(significant, true / np.where(significant, layer, 1.0), otherwise)


def _key(values: Mapping[str, float]) -> Key:
    return tuple(sorted(values.items()))


def leaning(indenter: Indenter, tip: Array, tilt: tuple[float, float]) -> tuple[Indenter, Array]:
    """Return indenter and tips (n, 3) [m] as a pad sees them that is tilted about x and y [rad].

    The tip's height is that of the indenter's lowest point, as a search for the surface finds it.
    """
    if not any(tilt):
        return indenter, tip.copy()
    return indenter.tilted(-tilt[0], -tilt[1]), tip - np.cross(np.array([*tilt, 0.0]), tip)


def printed(indenter: Indenter, size: float) -> Indenter:
    """Return an indenter whose width, of `WIDTH` if it has none, is greater by `size` [m]."""
    width = float(np.diff(indenter.bounds[0])[0])
    scale = 1 + size / (width if np.isfinite(width) else WIDTH)
    if scale == 1:
        return indenter
    angles = {"half_plane": (0, 1), "band": (0, 1), "circle": (), "path": range(2, 10**6, 3)}
    parts = []
    for part in indenter.parts:
        kept = angles[part.figure]
        values = tuple(each if k in kept else each * scale for k, each in enumerate(part.values))
        axis = part.axis[0] * scale, part.axis[1] * scale
        parts.append(replace(part, values=values, axis=axis))
    edge, narrowest = indenter.edge_radius * scale, indenter.narrowest * scale
    return replace(indenter, parts=tuple(parts), edge_radius=edge, narrowest=narrowest)


def relaxing(time: Array, elastic: Array, relaxation: float) -> Array:
    """Return the convolution (n, 3) of an elastic force's changes with exp(-t / relaxation)."""
    branch = np.zeros_like(elastic)
    for row in range(1, len(time)):
        span = (time[row] - time[row - 1]) / relaxation
        gain = -math.expm1(-span) / span if span > 0 else 1.0
        change = elastic[row] - elastic[row - 1]
        branch[row] = math.exp(-span) * branch[row - 1] + gain * change
    return branch


def _rates(time: Array, force: Array) -> Array:
    """Return the rate of the interval that ends at each point (n, 3)."""
    span = np.maximum(np.diff(time), 1e-4)
    return np.concatenate([np.zeros((1, 3)), np.diff(force, axis=0) / span[:, None]])
