"""Fit of a twin without a gauge: the skin from the motion of its markers, its scale from a weight.

How far markers move under a rigid tip at a known place depends on thickness, Poisson's ratio and
friction, not on the modulus. A known weight on a tip presses as deep as its markers show, and the
force of the skin there gives the modulus. Errors of the bench are unknowns with priors.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from recorder.archive import MarkerArchive
from recorder.markers import find_blobs, smallest_marker, unpack
from recorder.processes import several
from sim.arrays import Array, Progress
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import named
from sim.layer import Layer
from sim.result import ContactTier, Result
from sim.scene import Effects, Scene
from sim.sensors import CameraSignal, Posterior, SimulatedSensor, SurfaceField
from sim.sensors.posterior import CAMERA, interval_of
from sim.sensors.quantities import camera_quantities, quantities, with_camera, with_quantities
from sim.tiers import simulate_many
from sim.twin.fit import UNIDENTIFIED, Uncertainty, Z, moved_by, way_of, with_effects
from sim.twin.fit import PRIOR as PRIOR_OF_GAUGE
from sim.twin.markers import LOST, Follower, MarkerObservations
from sim.twin.model import leaning, motion_of, printed

# Prior spreads as in `sim.twin.fit`; those after `@` in a name are of one mounting of an indenter.
PRIOR = {
    **PRIOR_OF_GAUGE,
    "thickness": 0.3,
    "poisson": 0.03,
    "height": 30e-6,
    "compliance": 7e-6,
    "place": 0.3e-3,
    "size": 0.1e-3,
    "turn": math.radians(1.5),
    "scale": 0.005,
    "distance": 0.03,
    "shift": 12.0,
    "rotation": math.radians(1.5),
    "mesh": 1.0,
}
# The same of a weight that is laid by hand, about where its markers show it.
LAID = {"place": 1e-3, "height": 0.5e-3, "tilt": 0.05}
# Acceleration of free fall that masses are weighed by [m/s^2].
GRAVITY = 9.80665
# Middle of the compliances of arm and mount [m/N].
COMPLIANCE = 8e-6
SKIN = ("thickness", "poisson", "friction")
CAMERA_FITTED = CAMERA[:5]
# Unknowns whose derivative takes a solution, with its step, and those that move a solution.
STEPS = {
    **{"thickness": 0.05, "poisson": -0.01, "friction": 0.15},
    **{"height": -30e-6, "tilt_x": 0.015, "tilt_y": 0.015, "size": 0.15e-3},
}
MOVES = {"place_x": 0.1e-3, "place_y": 0.1e-3, "turn": 0.01}
OF_CAMERA = {"scale": 0.01, "distance": 0.02, "shift_x": 3.0, "shift_y": 3.0, "rotation": 0.01}
# Mesh of tier `fem` that follows the contact, and that of the rougher one, whose difference is
# about its error; steps over the thickness.
FEM = Fem(fineness=0.8, augmentations=1, tolerance=1e-3, path_tolerance=1e-2)
ROUGHER, STEPS_OF_THICKNESS = 0.7, 20
# Most presses that are fitted, and deepest press over the thickness of the design.
PRESSES, DEEPEST = 12, 0.75
# Height from which a tip comes [m].
ABOVE = 50e-6
# Relative error of a force by the law, beside that of its mesh.
LAW = 0.015
# Most rounds, parts of a step that are tried, and the largest step in spreads that ends the fit.
ROUNDS, PARTS, SMALL = 8, (1.0, 0.4), 0.2
# Longest step of a round, of logarithms and of spreads of the prior.
LONGEST = 2.0
# Length over which errors of the model are alike, over the thickness.
ALIKE = 0.5
# Least noise of a marker [px], and least error of the model over the motion.
NOISE, MODEL = 0.02, 0.005
# Residual over their median beyond which a marker is another one.
WRONG = 10.0
# Depths over the thickness, and places [m], at which a weight is looked for.
DEPTHS, PLACES = np.linspace(0.1, 0.7, 9), np.linspace(-3e-3, 3e-3, 13)

Solve = Callable[[Sequence[Scene], Fem | Layer], Sequence[Any]]


@dataclass(frozen=True, slots=True, eq=False)
class MarkedPress:
    """Markers at the rests of one press."""

    name: str
    indenter: str
    mounting: int
    """Number of the mounting of the indenter."""
    tip: Array
    """Tip in the air and at each rest (f + 1, 3) [m]."""
    undeformed: Array
    """Markers without contact (m, 2) [px]."""
    observed: Array
    """The same at each rest (f, m, 2) [px], NaN where one was not found."""
    weight: float = 0.0
    """Weight on the indenter [N]; 0 if an arm holds it."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Skin under one press."""

    top: SurfaceField
    """Displacement at each rest of the layer with the markers."""
    force: Array
    """Normal force at each rest, over the modulus (f,) [m^2]."""


@dataclass(frozen=True, slots=True, eq=False)
class GaugelessFit(Uncertainty):
    """Result of a fit without a gauge; quantities of mountings end in `@` and a number."""

    design: SimulatedSensor
    values: Mapping[str, float]
    presses: tuple[MarkedPress, ...]
    predicted: tuple[Array, ...]
    """Markers of the twin at the rests of each press (f, m, 2) [px]."""
    noise: float
    """Standard deviation of a marker [px]."""
    model: float
    """Error of the model over the motion of a marker."""
    lost: tuple[str, ...]
    """Presses without a solution, which are not fitted."""
    rounds: int
    tier: ContactTier = "fem"

    @property
    def weighed(self) -> bool:
        """True if a weight gives the modulus."""
        return any(press.weight for press in self.presses)

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Quantities that keep their prior's value."""
        spreads = self.spreads
        return tuple(
            name for name in self.names if spreads[name] > UNIDENTIFIED * _prior(name, self.presses)
        )

    @property
    def sensor(self) -> SimulatedSensor:
        """The twin: the design with the fitted quantities, its camera and their posterior."""
        own = {**quantities(self.design), **{name: self.values[name] for name in SKIN}}
        own["modulus"] = self.values["modulus"]
        twin = with_quantities(self.design, own)
        twin = with_camera(twin, {name: self.values[name] for name in CAMERA_FITTED})
        relaxing = [name for name in own if name.startswith(("ratio", "time"))]
        fitted_names = [name for name in ("modulus", *SKIN, *CAMERA_FITTED)]
        rows = [self.names.index(name) for name in fitted_names]
        covariance = np.zeros((len(rows) + len(relaxing),) * 2)
        covariance[: len(rows), : len(rows)] = self.covariance[np.ix_(rows, rows)]
        for row, name in enumerate(relaxing, len(rows)):
            covariance[row, row] = _prior(name) ** 2
        arms = [press.mounting for press in self.presses if not press.weight]
        height = float(np.mean([self.values[f"height@{number}"] for number in arms]))
        names = (*fitted_names, *relaxing)
        return replace(twin, posterior=Posterior.of(names, covariance, self.tier, height, LAW))

    def interval(self, name: str, z: float = Z) -> tuple[float, float]:
        """Return the interval of a quantity, 90 % by default."""
        return interval_of(name, self.values[name], z * self.spreads[name])


def _prior(name: str, presses: Sequence[MarkedPress] = ()) -> float:
    kind, _, mounting = name.partition("@")
    kind = kind.partition("_")[0]
    if kind in LAID and any(p.weight and p.mounting == int(mounting) for p in presses):
        return LAID[kind]
    return PRIOR[kind]


def marked_presses(observations: Sequence[MarkerObservations]) -> list[MarkedPress]:
    """Return the presses of observations, until the tip goes back sideways: at most `PRESSES`."""
    presses: list[MarkedPress] = []
    numbers = {id(track): number for number, track in enumerate({id(o.track): o.track for o in observations}.values())}
    for each in observations:
        track = each.track
        for target in np.unique(track.target[each.rows]):
            own = np.flatnonzero(track.target[each.rows] == target)
            tips = track.tip[each.rows[own]]
            count = 1 + int(np.linalg.norm(tips[:, :2] - tips[0, :2], axis=1).argmax())
            tip = np.concatenate([[[*tips[0, :2], ABOVE]], tips[:count]])
            seen = each.observed[own[:count]]
            name = f"{track.name}, press {target}"
            presses.append(
                MarkedPress(name, track.indenter, numbers[id(track)], tip, each.undeformed, seen)
            )
    deepest = sorted(presses, key=lambda press: press.tip[:, 2].min())
    chosen = {id(press) for press in deepest[:PRESSES]}
    return [press for press in presses if id(press) in chosen]


class MarkerModel:
    """Markers that a candidate sensor would show in presses."""

    def __init__(
        self, design: SimulatedSensor, presses: Sequence[MarkedPress], tier: ContactTier, solve: Solve
    ) -> None:
        deep = 0.9 * design.body.thickness
        friction = Effects(friction=design.effects.friction)
        self._design = replace(
            design, effects=friction, trajectory=None, force_depth=None, depth_max=deep
        )
        assert isinstance(design.signal, CameraSignal)
        self._pins, self._camera = design.signal.pins, design.signal.camera()
        self.presses = list(presses)
        self.lost: list[str] = []
        self._solve = solve
        self._tier = replace(FEM, step_travel=design.body.thickness / STEPS_OF_THICKNESS)
        self._layer = tier == "layer"

    def scene(self, press: MarkedPress, values: Mapping[str, float], yields: Array) -> Scene:
        """Return the scene of a press whose mount yields by some lengths (f,) [m]."""
        at = {name.partition("@")[0]: value for name, value in values.items() if name.endswith(f"@{press.mounting}")}
        sensor = with_quantities(self._design, {name: values[name] for name in SKIN})
        place = np.array([at["place_x"], at["place_y"], 0.0])
        indenter, tip = leaning(
            printed(named(press.indenter), at["size"]), press.tip + place, (at["tilt_x"], at["tilt_y"])
        )
        tip[1:, 2] += yields - at["height"]
        tip[:, 2] = np.maximum(tip[:, 2], -0.999 * sensor.depth_max)
        way = np.linalg.norm(np.diff(tip, axis=0), axis=1)
        return sensor.scene(indenter, motion_of(tip, np.r_[0.0, np.cumsum(way / sensor.speed + 1e-3)]))

    def solved(self, scenes: Sequence[Scene], finer: float = 1.0) -> list[Solution | None]:
        """Return the solutions of scenes, None where there is none."""
        first: Fem | Layer = Layer() if self._layer else replace(self._tier, fineness=finer * FEM.fineness)
        results = list(self._solve(scenes, first))
        failed = [k for k, each in enumerate(results) if isinstance(each, SimulationDiverged)]
        if failed and isinstance(first, Fem):
            assert first.step_travel is not None
            careful = replace(first, step_travel=first.step_travel / 4, precision="float64")
            again = self._solve([scenes[k] for k in failed], careful)
            for k, each in zip(failed, again, strict=True):
                results[k] = each
        return [self._solution(each) if isinstance(each, Result) else None for each in results]

    def _solution(self, result: Result) -> Solution:
        top = SurfaceField.of(result)
        if self._pins is not None:
            top = self._pins.tips(top)
        top = replace(top, displacement=top.displacement[1:])
        return Solution(top, -result.force[1:, 2] / result.scene.body.modulus)

    def predicted(
        self, press: MarkedPress, solution: Solution, values: Mapping[str, float],
        moved: tuple[float, float] = (0.0, 0.0),
    ) -> Array:
        """Return the markers at each rest (f, m, 2) [px], the solution moved sideways by (2,) [m]."""
        body = with_quantities(self._design, {"thickness": values["thickness"]}).body
        distance = values["distance"]
        camera = replace(
            self._camera,
            focal=distance / values["scale"],
            distance=distance,
            shift=(values["shift_x"], values["shift_y"]),
            rotation=values["rotation"],
        )
        flat = camera.places(press.undeformed, body)
        turn = values[f"turn@{press.mounting}"]
        turned = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        shift = solution.top.at(flat @ turned - np.array(moved))
        shift[..., :2] = shift[..., :2] @ turned.T
        points = np.column_stack([flat, body.heights_at(*flat.T)])
        return camera.project(points + shift)


@dataclass(frozen=True, slots=True, eq=False)
class Near:
    """Markers of a candidate and their derivatives, of every press."""

    values: Mapping[str, float]
    solutions: Sequence[Solution]
    markers: Sequence[Array]
    """Places (f, m, 2) [px]."""
    slopes: Sequence[Array]
    """Derivatives (f, m, 2, p)."""
    of_force: Sequence[Array]
    """Derivatives (p,) of the logarithm of the force at the last rest."""


@dataclass(frozen=True, slots=True, eq=False)
class Noise:
    """Errors of markers: `marker` [px] of each, and `model`, over its motion, of neighbours alike."""

    marker: float = 0.3
    model: float = 0.03


class GaugelessProblem:
    """Presses to explain by the quantities of a model."""

    def __init__(self, model: MarkerModel, design: SimulatedSensor) -> None:
        self.model, self.presses = model, model.presses
        own = ("place_x", "place_y", "turn", "height", "tilt_x", "tilt_y", "size")
        numbers = sorted({press.mounting for press in self.presses})
        self.names = (
            *("modulus", *SKIN, "compliance", *CAMERA_FITTED),
            *(f"{name}@{number}" for number in numbers for name in own),
            *(f"mesh_{number}" for number in range(len(self.presses))),
        )
        camera = {name: camera_quantities(design)[name] for name in CAMERA_FITTED}
        known = {**quantities(design), **camera, "compliance": COMPLIANCE}
        self.centre = {name: known.get(name, 0.0) for name in self.names}
        self.prior = np.array([_prior(name, self.presses) for name in self.names])

    def offset(self, values: Mapping[str, float]) -> Array:
        """Return the distance of values from the prior's centre (p,)."""
        return np.array([way_of(name, self.centre, values) for name in self.names])

    def solved(
        self, candidates: Sequence[Mapping[str, float]], forces: Sequence[Array]
    ) -> list[list[Solution | None]]:
        """Return the solution of every press for some candidates; the mount yields by `forces`."""
        scenes = [
            self.model.scene(press, values, self._yields(press, values, force))
            for values in candidates
            for press, force in zip(self.presses, forces, strict=True)
        ]
        every, count = self.model.solved(scenes), len(self.presses)
        return [every[count * k : count * (k + 1)] for k in range(len(candidates))]

    @staticmethod
    def _yields(press: MarkedPress, values: Mapping[str, float], force: Array) -> Array:
        stiff = 0.0 if press.weight else values["compliance"] * values["modulus"]
        return np.asarray(stiff * force)

    def linearised(self, values: Mapping[str, float], solutions: Sequence[Solution]) -> Near:
        """Return markers and derivatives at values whose solutions are known."""
        scenes, meaning = [], []
        for k, (press, solution) in enumerate(zip(self.presses, solutions, strict=True)):
            yields = self._yields(press, values, solution.force)
            for name, step in STEPS.items():
                moved = _moved(name if name in SKIN else f"{name}@{press.mounting}", values, step)
                scenes.append(self.model.scene(press, moved, yields))
                meaning.append((k, name, moved))
        solved = self.model.solved(scenes)
        markers = [
            self.model.predicted(press, solution, values)
            for press, solution in zip(self.presses, solutions, strict=True)
        ]
        slopes = [np.zeros((*each.shape, len(self.names))) for each in markers]
        of_force = [np.zeros(len(self.names)) for _ in markers]
        for (k, name, moved), solution in zip(meaning, solved, strict=True):
            if solution is None:
                continue
            full = name if name in SKIN else f"{name}@{self.presses[k].mounting}"
            self._solved_slope(k, full, solution, solutions[k], markers[k], values, moved, slopes, of_force)
        for k, press in enumerate(self.presses):
            self._other_slopes(k, press, solutions[k], markers[k], values, slopes[k], of_force[k])
        return Near(values, solutions, markers, slopes, of_force)

    def _solved_slope(self, k, name, solution, base, markers, values, moved, slopes, of_force) -> None:
        column, way = self.names.index(name), way_of(name, values, moved)
        there = self.model.predicted(self.presses[k], solution, moved)
        slopes[k][..., column] = (there - markers) / way
        of_force[k][column] = math.log(solution.force[-1] / base.force[-1]) / way

    def _other_slopes(self, k, press, solution, markers, values, slopes, of_force) -> None:
        index, number = self.names.index, press.mounting
        for axis in (0, 1):
            step = 0.1e-3
            way = (step, 0.0) if axis == 0 else (0.0, step)
            there = self.model.predicted(press, solution, values, way)
            slopes[..., index(f"place_{'xy'[axis]}@{number}")] = (there - markers) / step
        for name, step in OF_CAMERA.items() | {f"turn@{number}": 0.01}.items():
            moved = _moved(name, values, step)
            there = self.model.predicted(press, solution, moved)
            slopes[..., index(name)] = (there - markers) / way_of(name, values, moved)
        if not press.weight:
            # The mount yields by compliance times force, as if the surface were lower.
            height = slopes[..., index(f"height@{number}")]
            lower = -values["modulus"] * solution.force[:, None, None]
            slopes[..., index("compliance")] = height * lower
            slopes[..., index("modulus")] = height * lower * values["compliance"]
        of_force[index("modulus")] = 1.0

    def with_mesh(self, near: Near) -> Near:
        """Return derivatives with those by the error of the mesh."""
        scenes = [
            self.model.scene(press, near.values, self._yields(press, near.values, solution.force))
            for press, solution in zip(self.presses, near.solutions, strict=True)
        ]
        for k, rough in enumerate(self.model.solved(scenes, ROUGHER)):
            if rough is not None:
                column = self.names.index(f"mesh_{k}")
                there = self.model.predicted(self.presses[k], rough, near.values)
                near.slopes[k][..., column] = there - near.markers[k]
                near.of_force[k][column] = math.log(rough.force[-1] / near.solutions[k].force[-1])
        return near


def _moved(name: str, values: Mapping[str, float], step: float) -> dict[str, float]:
    return {**values, name: moved_by(name, values, step)}


def _known(near: Near, presses: Sequence[MarkedPress]) -> list[NDArray[np.bool_]]:
    """Return the markers that were found at each rest of every press (f, m), without wrong ones."""
    sizes = [
        np.linalg.norm(press.observed - markers, axis=-1)
        for press, markers in zip(presses, near.markers, strict=True)
    ]
    most = max(1.0, WRONG * float(np.nanmedian(np.concatenate([each.ravel() for each in sizes]))))
    return [np.nan_to_num(each, nan=np.inf) < most for each in sizes]


class Weighing:
    """Axes along which the errors of markers are independent, at each rest, and their variances.

    Each marker has a noise of its own. Errors of the model are in proportion to the motion, and
    alike in markers that are near one another: `alike` (r,) are their variances along the axes.
    """

    def __init__(self, problem: GaugelessProblem, near: Near) -> None:
        self.noise = Noise()
        self._problem, self._near = problem, near
        self._known = _known(near, problem.presses)
        self._axes: list[list[Array]] = []
        alike = []
        reach = ALIKE * near.values["thickness"] / near.values["scale"]
        for press, markers, known in zip(problem.presses, near.markers, self._known, strict=True):
            apart = press.undeformed[:, None] - press.undeformed
            near_by = np.exp(-np.linalg.norm(apart, axis=-1) / reach)
            self._axes.append([])
            for seen, rows in zip(markers, known, strict=True):
                moved = np.linalg.norm(seen - press.undeformed, axis=-1)[rows]
                values, axes = np.linalg.eigh(near_by[np.ix_(rows, rows)] * np.outer(moved, moved))
                self._axes[-1].append(axes)
                alike.append(np.repeat(np.maximum(values, 0.0), 2))
        self.alike = np.concatenate(alike)
        self.weights = sum(press.weight > 0 for press in problem.presses)
        self.residual = self.off(near.solutions, near.markers, near.values)
        pairs = zip(problem.presses, near.of_force, strict=True)
        forces = [each[None] for press, each in pairs if press.weight]
        self.jacobian = np.concatenate([self._turned(near.slopes), *forces])
        self.offset = problem.offset(near.values) / problem.prior

    def _turned(self, arrays: Sequence[Array]) -> Array:
        """Return values of markers (f, m, 2, ...) of every press along the axes (r, ...)."""
        parts = [
            (axes.T @ each[frame][rows].reshape(rows.sum(), -1)).reshape(-1, *each.shape[3:])
            for each, own, known in zip(arrays, self._axes, self._known, strict=True)
            for frame, (axes, rows) in enumerate(zip(own, known, strict=True))
        ]
        return np.concatenate(parts)

    def off(
        self, solutions: Sequence[Solution], markers: Sequence[Array], values: Mapping[str, float]
    ) -> Array:
        """Return all residuals (r + w,): of markers [px], and of logarithms of weights."""
        presses = self._problem.presses
        missed = [
            np.nan_to_num(press.observed - each)
            for press, each in zip(presses, markers, strict=True)
        ]
        forces = [
            math.log(press.weight / (values["modulus"] * solution.force[-1]))
            for press, solution in zip(presses, solutions, strict=True)
            if press.weight
        ]
        return np.concatenate([self._turned(missed), forces])

    def information(self, noise: Noise) -> tuple[Array, Array]:
        """Return the inverse of each residual's variance (r + w,), and that of the covariance."""
        sure = self.information_of(noise)
        normal = self.jacobian.T @ (sure[:, None] * self.jacobian)
        return sure, normal + np.diag(self._problem.prior**-2)

    def cost(self, noise: Noise, residual: Array, offset: Array) -> float:
        """Return the squares of residuals (r + w,) and offsets (p,) in standard errors."""
        return float(self.information_of(noise) @ np.square(residual) + offset @ offset)

    def information_of(self, noise: Noise) -> Array:
        """Return the inverse of each residual's variance (r + w,)."""
        variance = noise.marker**2 + noise.model**2 * self.alike
        return np.r_[1 / variance, np.full(self.weights, LAW**-2)]

    def step(self, noise: Noise) -> tuple[Array, Array]:
        """Return the step (p,) to the least cost, and the covariance there (p, p)."""
        sure, normal = self.information(noise)
        slope = self.jacobian.T @ (sure * self.residual) - self.offset / self._problem.prior
        covariance = np.linalg.inv(normal)
        return np.asarray(covariance @ slope), np.asarray(covariance)

    def estimated(self) -> Noise:
        """Return the errors under which residuals are likeliest, quantities unknown (REML)."""

        def unlikely(logs: Array) -> float:
            noise = _noise(logs)
            sure, normal = self.information(noise)
            slope = self.jacobian.T @ (sure * self.residual) - self.offset / self._problem.prior
            gained = float(slope @ np.linalg.solve(normal, slope))
            determinants = np.linalg.slogdet(normal)[1] - np.log(sure).sum()
            return self.cost(noise, self.residual, self.offset) - gained + float(determinants)

        options = {"maxfev": 60, "xatol": 0.03, "fatol": 0.1}
        start = np.log([self.noise.marker, self.noise.model])
        return _noise(minimize(unlikely, start, method="Nelder-Mead", options=options).x)


def _noise(logs: Array) -> Noise:
    marker, model = np.exp(logs).tolist()
    return Noise(max(marker, NOISE), max(model, MODEL))


def fitted_without_gauge(
    presses: Sequence[MarkedPress],
    design: SimulatedSensor,
    *,
    tier: ContactTier = "fem",
    device: str = "cpu",
    processes: int = 1,
    solve: Solve | None = None,
    progress: Progress = lambda fraction: None,
) -> GaugelessFit:
    """Return the twin that explains how far markers move in presses of one sensor.

    A press with a weight gives the modulus, which keeps its prior without one. `solve` replaces
    `simulate_many` on the device.

    Raises:
        SceneError: There is no press, or a tip goes too deep for the design.
        SimulationDiverged: No press has a solution.
    """
    design = with_effects(design)
    most = DEEPEST * design.body.thickness
    for press in presses:
        if not 0 < -press.tip[:, 2].min() <= most:
            raise SceneError(
                f"{press.name}: {-1e3 * press.tip[:, 2].min():.3g} mm deep; allowed: above 0, up "
                f"to {1e3 * most:.3g} mm in {design.name}"
            )
    if not any(not press.weight for press in presses):
        raise SceneError("presses: none by an arm at known places; allowed: 1 or more")
    if solve is not None:
        return _fit(MarkerModel(design, presses, tier, solve), design, tier, progress)
    with several(processes) as workers:
        own = partial(simulate_many, device=device, processes=workers or 1)
        many = own if device == "cpu" else lambda scenes, fem: own(scenes, _at_once(fem))
        return _fit(MarkerModel(design, presses, tier, many), design, tier, progress)


def _at_once(tier: Fem | Layer) -> Fem | Layer:
    return replace(tier, one_topology=True) if isinstance(tier, Fem) else tier


def _fit(model: MarkerModel, design: SimulatedSensor, tier: ContactTier, progress: Progress) -> GaugelessFit:
    model.presses = [_laid(model, press, design) if press.weight else press for press in model.presses]
    problem, values, solutions = _begun(model, design)
    damped = False
    for done in range(1, ROUNDS + 1):
        progress(done / (ROUNDS + 1))
        weighing = Weighing(problem, problem.linearised(values, solutions))
        noise = weighing.estimated()
        step, covariance = weighing.step(noise)
        step *= min(1.0, LONGEST / float(np.max(np.abs(step) / problem.prior)))
        small = float(np.max(np.abs(step) / np.sqrt(np.diag(covariance)))) < SMALL
        cost = weighing.cost(noise, weighing.residual, weighing.offset)
        best = _best_of(problem, weighing, noise, values, solutions, step)
        if best is None or best[0] > cost:
            if damped or small:
                break
            damped = True
            continue
        damped = False
        _, values, solutions = best
        if small or cost - best[0] < 0.5:
            break
    near = problem.with_mesh(problem.linearised(values, solutions))
    weighing = Weighing(problem, near)
    noise = weighing.estimated()
    _, covariance = weighing.step(noise)
    progress(1.0)
    return GaugelessFit(
        names=problem.names,
        covariance=covariance,
        design=design,
        values=values,
        presses=tuple(problem.presses),
        predicted=tuple(near.markers),
        noise=noise.marker,
        model=noise.model,
        lost=tuple(model.lost),
        rounds=done,
        tier=tier,
    )


def _begun(
    model: MarkerModel, design: SimulatedSensor
) -> tuple[GaugelessProblem, dict[str, float], list[Solution]]:
    """Return the problem of presses that have a solution, and its beginning."""
    problem = GaugelessProblem(model, design)
    values = dict(problem.centre)
    (first,) = problem.solved([values], [np.zeros(len(p.observed)) for p in problem.presses])
    model.lost = [p.name for p, s in zip(model.presses, first, strict=True) if s is None]
    model.presses = [p for p, s in zip(model.presses, first, strict=True) if s is not None]
    if not any(not press.weight for press in model.presses):
        raise SimulationDiverged(f"{design.name}: no press by an arm has a solution")
    return GaugelessProblem(model, design), values, [s for s in first if s is not None]


def _best_of(
    problem: GaugelessProblem, weighing: Weighing, noise: Noise, values: Mapping[str, float],
    solutions: Sequence[Solution], step: Array,
) -> tuple[float, dict[str, float], list[Solution]] | None:
    """Return the least cost along a step, with its values and solutions."""
    tried = []
    for part in PARTS:
        moved = dict(values)
        for name, by in zip(problem.names, part * step, strict=True):
            moved[name] = moved_by(name, values, by)
        tried.append(moved)
    best = None
    forces = [solution.force for solution in solutions]
    for moved, solved in zip(tried, problem.solved(tried, forces), strict=True):
        if any(each is None for each in solved):
            continue
        there = [each for each in solved if each is not None]
        markers = [problem.model.predicted(p, s, moved) for p, s in zip(problem.presses, there, strict=True)]
        residual = weighing.off(there, markers, moved)
        cost = weighing.cost(noise, residual, problem.offset(moved) / problem.prior)
        if best is None or cost < best[0]:
            best = cost, moved, there
    return best


def _laid(model: MarkerModel, press: MarkedPress, design: SimulatedSensor) -> MarkedPress:
    """Return a weight's press at the depth and place that its markers show on the design."""
    depths = design.body.thickness * DEPTHS
    path = np.zeros((len(depths) + 1, 3))
    path[:, 2] = np.r_[ABOVE, -depths]
    problem = GaugelessProblem(model, design)
    (solution,) = model.solved([model.scene(replace(press, tip=path), problem.centre, np.zeros(len(depths)))])
    if solution is None:
        raise SimulationDiverged(f"{press.name}: {press.indenter} has no solution on {design.name}")
    best = (math.inf, 0.0, (0.0, 0.0))
    for x in PLACES:
        for y in PLACES:
            off = model.predicted(press, solution, problem.centre, (x, y)) - press.observed[-1]
            square = np.nanmedian(np.square(off).sum(axis=-1), axis=-1)
            best = min(best, (float(square.min()), float(depths[square.argmin()]), (x, y)))
    _, depth, (x, y) = best
    return replace(press, tip=np.array([[x, y, ABOVE], [x, y, -depth]]))
