"""Fit of a twin without a gauge: the skin from the motion of its markers, its scale from a weight.

How far markers move under a rigid tip at a known place depends on thickness, Poisson's ratio and
friction, not on the modulus. A known weight on a tip presses as deep as its markers show, and the
force of the skin there gives the modulus. Errors of the bench are unknowns with priors.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from recorder.archive import MarkerArchive
from recorder.markers import unpack
from recorder.processes import several
from sim.arrays import Array, Progress
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import indenter_of
from sim.layer import Layer
from sim.markers import Camera
from sim.result import ContactTier, Result
from sim.scene import Effects, Scene
from sim.sensors import Posterior, SimulatedSensor, SurfaceField
from sim.sensors.posterior import CAMERA
from sim.sensors.quantities import camera_quantities, quantities, with_camera, with_quantities
from sim.tiers import simulate, simulate_many
from sim.twin import fit as gauged
from sim.twin.markers import LOST, Follower, MarkerObservations, camera_signal
from sim.twin.model import leaning, motion_of, printed
from sim.twin.plan import PlannedPresses, planned_presses

# Prior spreads, as in `sim.twin.fit`. Names of what is of one mounting of an indenter end in `@`
# and its number.
PRIOR = {
    **gauged.PRIOR,
    **{"thickness": 0.3, "poisson": 0.03, "compliance": 7e-6, "turn": 0.026, "height": 30e-6},
    **{"place": 0.3e-3, "size": 0.1e-3, "mesh": 0.5},
    **{"scale": 0.005, "distance": 0.03, "shift": 12.0, "rotation": 0.026},
}
# The same of a weight that is laid by hand, about where its markers show it.
LAID = {"place": 1e-3, "height": 0.5e-3, "tilt": 0.05}
# Compliance of arm and mount in the middle of its prior [m/N], and gravity [m/s^2].
COMPLIANCE, GRAVITY = 8e-6, 9.80665
SKIN, VIEW = ("thickness", "poisson", "friction"), CAMERA[:5]
# Quantities of a sensor that are fitted, the first of all.
OF_SENSOR = ("modulus", *SKIN, *VIEW)
# Steps of derivatives: of a mounting and of the skin, those that take a solution and the others.
PLACED = {"place_x": 1e-4, "place_y": 1e-4, "turn": 0.01}
OWN = {"height": -30e-6, "tilt_x": 0.015, "tilt_y": 0.015, "size": 0.15e-3}
COSTLY = {"thickness": 0.05, "poisson": -0.01, "friction": 0.15, **OWN}
CHEAP = {**dict(zip(VIEW, (0.01, 0.02, 3.0, 3.0, 0.01), strict=True)), **PLACED}
# Mesh that follows the contact; on a CPU it is rougher: a round of seven presses then takes some
# three minutes of a core. Longest step of the tip over the thickness.
FEM = Fem(fineness=0.8, augmentations=1, tolerance=1e-3)
FEM_OF_CPU, LAYER, TRAVEL = replace(FEM, fineness=0.65), Layer(grid=64), 0.05
# Fineness of a rougher mesh over it, whose difference is about the error of both; true markers
# beyond those of the finer one, over that difference, in the middle of the prior.
ROUGHER, MESH = 0.7, -0.5
# Most presses of a fit, deepest one over the thickness, and height from which a tip comes [m].
PRESSES, DEEPEST, ABOVE = 8, 0.75, 50e-6
# Most rounds, largest step that ends a fit in spreads of the result, longest step in spreads of the
# prior, by which a step is shortened that led nowhere, and from which it is given up.
ROUNDS, SMALL, LONGEST, SHORTER, SHORTEST = 8, 0.3, 2.0, 0.3, 0.1
# Relative error of a force by the law, beside that of its mesh; length over which errors of the
# model are alike, over the thickness.
LAW, ALIKE = 0.015, 0.5
# Least noise of a marker [px], least error of the model over the motion, and where both begin.
LEAST, BEGUN = (0.02, 0.01), (0.3, 0.03)
# Distance over the median one beyond which a marker is taken for another one; part of the largest
# motion from which a weight rests on the tip.
WRONG, RESTS = 10.0, 0.8
# Depths over the thickness, and places [m], at which a weight is looked for.
DEPTHS, PLACES = np.linspace(0.06, 0.54, 9), np.linspace(-3e-3, 3e-3, 13)
# Smooth indenters, which have solutions on all skins; depth and way sideways of a plan over the
# thickness, and its holds [s].
SMOOTH, PRESSED, SHEARED, HOLD = ("sphere", "sphere_s", "hemisphere"), 0.27, 0.22, 1.0
# Corners of a polygon about a marker over its radius (16, 2).
TURNS = np.arange(0.0, 2 * np.pi, np.pi / 8)
ROUND = np.column_stack([np.cos(TURNS), np.sin(TURNS)])
# Usual masses [kg], and depth over the thickness up to which a skin bears one.
MASSES, BEARS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0), 0.35

Values = Mapping[str, float]
Pair = tuple[float, float]
Numerics = Fem | Layer
Solve = Callable[[Sequence[Scene], Any], Sequence[Any]]


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
    """Weight that presses [N], NaN if it is not known; 0 if an arm does."""
    radius: float = 1.0
    """Radius of a disc as large as a marker [px]."""

    def full(self, name: str) -> str:
        """Return the full name of a quantity, which may be of its mounting."""
        return f"{name}@{self.mounting}" if name in PLACED or name in OWN else name


class Solution(NamedTuple):
    """Displacement of the markers' layer at each rest, and normal force over the modulus (f,)."""

    top: SurfaceField
    force: Array


class Near(NamedTuple):
    """A candidate: forces over the modulus (f,) and markers (f, m, 2) [px] of each press.

    With derivatives of markers (f, m, 2, p), and of the logarithm of the last force (p,).
    """

    values: dict[str, float]
    forces: list[Array]
    markers: list[Array]
    slopes: list[Array]
    of_force: list[Array]


@dataclass(frozen=True, slots=True, eq=False)
class GaugelessFit(gauged.Identified):
    """Result of a fit without a gauge."""

    presses: tuple[MarkedPress, ...]
    predicted: tuple[Array, ...]
    """Markers of the twin at the rests of each press (f, m, 2) [px]."""
    noise: Pair
    """Noise of a marker [px], and error of the model over its motion."""
    rounds: int
    tier: ContactTier
    device: str

    @property
    def weighed(self) -> bool:
        """True if a weight gives the modulus."""
        return any(press.weight for press in self.presses)

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Quantities of sensor and camera that keep their prior's value."""
        spreads = self.spreads
        return tuple(n for n in OF_SENSOR if spreads[n] > gauged.UNIDENTIFIED * _prior(n))

    @property
    def sensor(self) -> SimulatedSensor:
        """The twin with its camera and posterior; relaxation is the design's."""
        count, values = len(OF_SENSOR), self.values
        twin = with_quantities(self.design, {name: values[name] for name in ("modulus", *SKIN)})
        twin = with_camera(twin, {name: values[name] for name in VIEW})
        names = dict.fromkeys((*OF_SENSOR, *quantities(self.design)))
        covariance = np.diag([_prior(name) ** 2 for name in names])
        covariance[:count, :count] = self.covariance[:count, :count]
        arms = [press.full("height") for press in self.presses if not press.weight]
        height = float(np.mean([values[name] for name in arms]))
        return replace(twin, posterior=Posterior.of([*names], covariance, self.tier, height, LAW))

    def force_of(self, press: MarkedPress) -> Pair:
        """Return the force [N] under which markers are as in a press that was not fitted.

        With the standard deviation of its logarithm.
        """
        unknown = replace(press, weight=math.nan if press.weight else 0.0)
        problem = Problem(self.design, [unknown], *_numerics(self.tier, self.device))
        count = len(OF_SENSOR)
        problem.precision[:count, :count] = np.linalg.inv(self.covariance[:count, :count])
        problem.centre |= {name: self.values[name] for name in OF_SENSOR}
        values, errors, _ = problem.descended()
        near, (slope,) = errors.near, errors.near.of_force
        moved = slope @ gauged.ways_of(problem.names, near.values, values)
        force = near.values["modulus"] * float(near.forces[0][-1]) * math.exp(moved)
        return force, math.sqrt(slope @ errors.covariance @ slope + LAW**2)


def _prior(name: str, laid: Collection[str] = ()) -> float:
    """Return the prior's spread of a quantity; mountings `laid` are of weights."""
    kind, _, number = name.partition("@")
    kind = kind.partition("_")[0]
    return LAID.get(kind, PRIOR[kind]) if number in laid else PRIOR[kind]


class Problem:
    """Presses to explain by the quantities of a skin, its camera and its bench.

    Known weights are equations for the modulus. Where one presses is looked for if its tip is not
    known: all 0.
    """

    def __init__(
        self, design: SimulatedSensor, presses: Sequence[MarkedPress], solve: Solve, tier: Numerics
    ) -> None:
        self._signal, deepest = camera_signal(design), 0.9 * design.body.thickness
        effects = Effects(friction=design.effects.friction)
        self._design = replace(with_quantities(design, {}), depth_max=deepest, effects=effects)
        self._solve, self._tier = solve, tier
        mountings = dict.fromkeys(press.mounting for press in presses)
        self.names = (
            *(*OF_SENSOR, "compliance"),
            *(f"{name}@{number}" for number in mountings for name in (*PLACED, *OWN)),
            *(f"mesh_{number}" for number in range(len(presses))),
        )
        known = {**quantities(design), **camera_quantities(design), "compliance": COMPLIANCE}
        self.centre = {name: known.get(name, 0.0) for name in self.names}
        laid = {str(press.mounting) for press in presses if press.weight}
        self._spreads = np.array([_prior(name, laid) for name in self.names])
        self.precision = np.diag(self._spreads**-2)
        self.presses = [press if press.tip.any() else self._found(press) for press in presses]

    def _scene(self, press: MarkedPress, values: Values, force: Array | float = 0.0) -> Scene:
        """Return the scene of a press whose mount yields by a force over the modulus (f,)."""
        at = {name: values[press.full(name)] for name in (*PLACED, *OWN)}
        sensor = with_quantities(self._design, {name: values[name] for name in SKIN})
        indenter = printed(indenter_of(press.indenter), at["size"])
        tip = press.tip + np.array([at["place_x"], at["place_y"], 0.0])
        indenter, tip = leaning(indenter, tip, (at["tilt_x"], at["tilt_y"]))
        tip[1:, 2] -= at["height"]
        if not press.weight:
            tip[1:, 2] += values["compliance"] * values["modulus"] * force
        tip[:, 2] = np.maximum(tip[:, 2], -sensor.depth_max)
        way = np.linalg.norm(np.diff(tip, axis=0), axis=1) + 1e-6
        return sensor.scene(indenter, motion_of(tip, np.r_[0.0, np.cumsum(way) / sensor.speed]))

    def _solved(self, scenes: Sequence[Scene], finer: float = 1.0) -> list[Solution | None]:
        """Return the solutions of scenes, None where there is none, tried again in small steps."""
        tier, travel = self._tier, TRAVEL * self._design.body.thickness
        if isinstance(tier, Fem):
            tier = replace(tier, fineness=finer * tier.fineness, step_travel=travel)
        solved = list(self._solve(scenes, tier))
        failed = [k for k, each in enumerate(solved) if not isinstance(each, Result)]
        if failed and isinstance(tier, Fem):
            tier = replace(tier, step_travel=travel / 4, precision="float64")
            for k, each in zip(failed, self._solve([scenes[k] for k in failed], tier), strict=True):
                solved[k] = each
        return [self._solution(each) if isinstance(each, Result) else None for each in solved]

    def _solution(self, result: Result) -> Solution:
        top, pins = SurfaceField.of(result), self._signal.pins
        top = top if pins is None else pins.tips(top)
        force = np.maximum(-result.force[1:, 2], 1e-9) / result.scene.body.modulus
        return Solution(replace(top, displacement=top.displacement[1:]), force)

    def markers(self, press: MarkedPress, there: Solution, values: Values, solved: Values) -> Array:
        """Return the markers at each rest (f, m, 2) [px], where `solved` has another place."""
        body = replace(self._design.body, thickness=values["thickness"])
        scale, distance, column, row, rotation = (values[name] for name in VIEW)
        tilt = self._signal.camera().tilt
        camera = Camera(distance / scale, distance, (column, row), rotation, tilt)
        radius = press.radius if self._signal.pins is None else 1.0  # a pin's head is rigid
        outlines = press.undeformed[:, None] + radius * ROUND
        flat = camera.places(outlines.reshape(-1, 2), body)
        *way, angle = (values[press.full(name)] - solved[press.full(name)] for name in PLACED)
        angle += solved[press.full("turn")]
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        moved = there.top.at(flat @ turn - np.array(way))
        moved[..., :2] = moved[..., :2] @ turn.T
        seen = camera.project(np.column_stack([flat, body.heights_at(*flat.T)]) + moved)
        return _middles(seen.reshape(len(moved), *outlines.shape))

    def _found(self, press: MarkedPress) -> MarkedPress:
        """Return a weight's press at the depth and place that its markers show on the design."""
        path = np.zeros((len(DEPTHS) + 1, 3))
        path[:, 2] = np.r_[ABOVE, -DEPTHS * self._design.body.thickness]
        solved = self._solved([self._scene(replace(press, tip=path), self.centre)])
        solution, tried = _required(press, solved[0]), []
        for x, y in product(PLACES, PLACES):
            at = {**self.centre, press.full("place_x"): x, press.full("place_y"): y}
            off = self.markers(press, solution, at, self.centre) - press.observed[-1]
            square = np.nanmedian(np.square(off).sum(axis=-1), axis=-1)
            tried.append((float(square.min()), x, y, path[1 + square.argmin(), 2]))
        _, x, y, z = min(tried)
        return replace(press, tip=np.array([[x, y, ABOVE], [x, y, z]]))

    def _near(self, values: dict[str, float], forces: Sequence[Array]) -> Near:
        """Return markers and derivatives at values; the mount yields by forces over the modulus."""
        names, scenes = self.names, []
        for press, force in zip(self.presses, forces, strict=True):
            steps = {press.full(name): by for name, by in COSTLY.items()}
            stepped = ({name: gauged.moved_by(name, values, by)} for name, by in steps.items())
            scenes += [self._scene(press, values | at, force) for at in ({}, *stepped)]
        solved, count = self._solved(scenes), 1 + len(COSTLY)
        near = Near(values, [], [], [], [])
        for k, press in enumerate(self.presses):
            first, *others = solved[count * k : count * (k + 1)]
            solution = _required(press, first)
            markers = self.markers(press, solution, values, values)
            slopes = dict.fromkeys(names, np.zeros_like(markers))
            of_force = dict.fromkeys(names, 0.0) | {"modulus": 1.0}
            steps = {press.full(name): by for name, by in (COSTLY | CHEAP).items()}
            others += [solution] * len(CHEAP)
            for (name, by), there in zip(steps.items(), others, strict=True):
                if there is not None:
                    moved = values | {name: gauged.moved_by(name, values, by)}
                    way = gauged.way_of(name, values, moved)
                    slopes[name] = (self.markers(press, there, moved, values) - markers) / way
                    of_force[name] = math.log(there.force[-1] / solution.force[-1]) / way
            if not press.weight:
                # The mount yields by compliance times force, as if the surface were lower.
                lower = -values["modulus"] * solution.force[:, None, None]
                slopes["compliance"] = slopes[press.full("height")] * lower
                slopes["modulus"] = slopes["compliance"] * values["compliance"]
            near.forces.append(solution.force)
            near.markers.append(markers)
            near.slopes.append(np.stack([slopes[name] for name in names], axis=-1))
            near.of_force.append(np.array([of_force[name] for name in names]))
        return near

    def descended(self, progress: Progress = lambda done: None) -> tuple[Values, Errors, int]:
        """Return where the quantities explain the presses best, begun at the prior's centre.

        With the errors at the candidate that a last step leads from, and rounds.

        Raises:
            SceneError: A tip is nearly through the skin.
            SimulationDiverged: A press has no solution.
        """
        forces, values, part = self._begun(), dict(self.centre), 1.0
        errors: Errors | None = None
        for done in range(1, ROUNDS + 1):
            progress(done / (ROUNDS + 1))
            try:
                near = self._near(values, forces)
                gained = math.inf if errors is None else errors.least - errors.cost(near)
            except SimulationDiverged:
                if errors is None:
                    raise
                gained = -math.inf
            if errors is None or gained > 0:
                errors, forces, part = Errors(self, near), near.forces, 1.0
                small = np.abs(errors.step) < SMALL * np.sqrt(np.diag(errors.covariance))
                if small[: len(OF_SENSOR)].all() or gained < SMALL:
                    break
                step = np.clip(errors.step, -LONGEST * self._spreads, LONGEST * self._spreads)
            elif part < SHORTEST:
                break
            else:
                part *= SHORTER
            values = gauged.moved_along(self.names, errors.near.values, part * step)
        assert errors is not None
        self._add_mesh(errors.near)
        errors = Errors(self, errors.near)
        values = gauged.moved_along(self.names, errors.near.values, errors.step)
        most = min(self._design.depth_max, 0.9 * values["thickness"])
        for press in self.presses:
            depth = values[press.full("height")] - float(press.tip[:, 2].min())
            if depth > most:
                allowed = f"allowed: up to {1e3 * most:.2f} mm: press less, or lay less weight"
                raise SceneError(f"{press.name}: the tip is {1e3 * depth:.2f} mm deep; {allowed}")
        return values, errors, done

    def _add_mesh(self, near: Near) -> None:
        """Add the derivatives by the error of the mesh, and the middle of its prior."""
        count, at = len(self.presses), near.values
        self.centre |= dict.fromkeys(self.names[-count:], MESH)
        pairs = zip(self.presses, near.forces, strict=True)
        solved = self._solved([self._scene(press, at, force) for press, force in pairs], ROUGHER)
        for k, (press, there) in enumerate(zip(self.presses, solved, strict=True)):
            if there is not None:
                off = self.markers(press, there, at, at) - near.markers[k]
                near.slopes[k][..., k - count] = off
                near.of_force[k][k - count] = math.log(there.force[-1] / near.forces[k][-1])

    def _begun(self) -> list[Array]:
        """Return forces over the modulus (f,) at the prior's centre, of a rigid mount."""
        solved = self._solved([self._scene(press, self.centre) for press in self.presses])
        return [_required(*each).force for each in zip(self.presses, solved, strict=True)]


def _middles(outlines: Array) -> Array:
    """Return the centroids (..., 2) of the areas inside polygons (..., k, 2).

    A marker is found at that of its image, which differs from the image of its middle where the
    skin is stretched unevenly: by some 1 % of the motion, beside a tip by 4 %.
    """
    middle = outlines.mean(axis=-2, keepdims=True)
    corner = outlines - middle
    after = np.roll(corner, -1, axis=-2)
    areas = corner[..., 0] * after[..., 1] - corner[..., 1] * after[..., 0]
    off = ((corner + after) * areas[..., None]).sum(axis=-2)
    return np.asarray(middle[..., 0, :] + off / (3 * areas.sum(axis=-1))[..., None])


def _required(press: MarkedPress, solution: Solution | None) -> Solution:
    if solution is None:
        raise SimulationDiverged(f"{press.name}: no solution for {press.indenter}; leave it out")
    return solution


class Errors:
    """Residuals of presses along axes in which their errors are independent.

    With the step (p,) to the least cost, and the covariance there (p, p).
    Each marker has a noise of its own. Errors of the model are in proportion to the motion, and
    alike in markers that are near one another. Weights have the error of the law.
    """

    def __init__(self, problem: Problem, near: Near) -> None:
        self._problem, self.near, self._presses = problem, near, problem.presses
        pairs = zip(self._presses, near.markers, strict=True)
        sizes = [np.linalg.norm(press.observed - markers, axis=-1) for press, markers in pairs]
        most = max(1.0, WRONG * float(np.nanmedian(np.concatenate(sizes, axis=None))))
        reach = ALIKE * near.values["thickness"] / near.values["scale"]
        self._rests, variances = [], []
        for k, press in enumerate(self._presses):
            apart = np.linalg.norm(press.undeformed[:, None] - press.undeformed, axis=-1)
            for rest, size in enumerate(sizes[k]):
                known = size < most  # False where one was not found
                moved = np.linalg.norm(near.markers[k][rest] - press.undeformed, axis=-1)
                alike = np.exp(-apart / reach) * np.outer(moved, moved)
                lengths, axes = np.linalg.eigh(alike[np.ix_(known, known)])
                self._rests.append((k, rest, known, axes.T))
                variances.append(np.repeat(np.maximum(lengths, 0.0), 2))
        self._alike = np.concatenate(variances)
        self._weights = [k for k, press in enumerate(self._presses) if press.weight > 0]
        self._residual, self._offset = self._off(near)
        forces = [near.of_force[k][None] for k in self._weights]
        self._slopes = np.concatenate([self._turned(near.slopes), *forces])
        # Noise of the image without contact is common to all rests of a mounting.
        most_rests = np.bincount([self._presses[k].mounting for k, *_ in self._rests]).max()
        shared = math.sqrt((most_rests + 1) / 2)
        self.noise = self._likeliest()
        self.step, self.covariance, _ = self._least(shared * self.noise[0], self.noise[1])
        self.least = self.cost(near)

    def _turned(self, arrays: Sequence[Array]) -> Array:
        """Return values of markers (f, m, 2, ...) of every press along the axes (r, ...)."""
        along = [np.tensordot(turn, arrays[k][f][known], 1) for k, f, known, turn in self._rests]
        return np.concatenate([each.reshape(-1, *each.shape[2:]) for each in along])

    def _off(self, near: Near) -> tuple[Array, Array]:
        """Return residuals (r + w,) of markers [px] and log weights, and the way from the prior."""
        presses, modulus = self._presses, near.values["modulus"]
        pairs, known = zip(presses, near.markers, strict=True), self._weights
        forces = [math.log(presses[k].weight / (modulus * near.forces[k][-1])) for k in known]
        residual = np.r_[self._turned([press.observed - each for press, each in pairs]), forces]
        return residual, gauged.ways_of(self._problem.names, self._problem.centre, near.values)

    def _sure(self, marker: float, model: float) -> Array:
        """Return the inverse variances of residuals (r + w,)."""
        markers = 1 / (marker**2 + model**2 * self._alike)
        return np.asarray(np.r_[markers, [LAW**-2] * len(self._weights)])

    def _squares(self, sure: Array, residual: Array, offset: Array) -> float:
        return float(sure @ np.square(residual) + offset @ self._problem.precision @ offset)

    def cost(self, near: Near) -> float:
        """Return the squares of residuals, and of the way from the prior, in standard errors."""
        return self._squares(self._sure(*self.noise), *self._off(near))

    def _least(self, marker: float, model: float) -> tuple[Array, Array, float]:
        """Return step and covariance, and how unlikely residuals are under a noise (REML)."""
        sure, slopes, precision = self._sure(marker, model), self._slopes, self._problem.precision
        normal = slopes.T @ (sure[:, None] * slopes) + precision
        covariance = np.linalg.inv(normal)
        step = covariance @ (slopes.T @ (sure * self._residual) - precision @ self._offset)
        left = self._squares(sure, self._residual - slopes @ step, self._offset + step)
        return step, covariance, left + np.linalg.slogdet(normal)[1] - np.log(sure).sum()

    def _likeliest(self) -> Pair:
        def errors(logs: Array) -> Pair:
            marker, model = np.maximum(np.exp(logs), LEAST).tolist()
            return marker, model

        how = {"maxfev": 60, "xatol": 0.03, "fatol": 0.1}
        logs, simplex = np.log(BEGUN), "Nelder-Mead"
        found = minimize(lambda at: self._least(*errors(at))[2], logs, method=simplex, options=how)
        return errors(found.x)


def solved_by(
    scenes: Sequence[Scene], tier: Numerics, *, device: str, processes: Any = 1
) -> list[Any]:
    """Return the outcomes of scenes; a GPU solves those of one indenter in one launch."""
    if device == "cpu" or isinstance(tier, Layer):
        return simulate_many(scenes, tier, device=device, processes=processes)
    outcomes: dict[int, Any] = {}
    for name in dict.fromkeys(scene.indenter.name for scene in scenes):
        own = {k: scene for k, scene in enumerate(scenes) if scene.indenter.name == name}
        alike = replace(tier, one_topology=True)
        outcomes |= zip(own, simulate_many([*own.values()], alike, device=device), strict=True)
    return [outcomes[k] for k in range(len(scenes))]


def _numerics(tier: ContactTier, device: str, processes: Any = 1) -> tuple[Solve, Numerics]:
    numerics = LAYER if tier == "layer" else FEM_OF_CPU if device == "cpu" else FEM
    return partial(solved_by, device=device, processes=processes), numerics


def fitted_without_gauge(
    presses: Sequence[MarkedPress],
    design: SimulatedSensor,
    *,
    tier: ContactTier = "fem",
    device: str = "cpu",
    processes: int = 1,
    progress: Progress = lambda fraction: None,
) -> GaugelessFit:
    """Return the twin that explains how far markers move in presses of one sensor.

    Without a press by a weight the modulus keeps its prior.

    Raises:
        SceneError: There is no press by an arm, one is too deep, or the design has no camera.
        SimulationDiverged: A press has no solution.
    """
    design, most = gauged.with_effects(design), 1e3 * DEEPEST * design.body.thickness
    if all(press.weight for press in presses):
        raise SceneError("presses: none by an arm; allowed: at least one at a known place")
    for press in presses:
        depth = -1e3 * press.tip[:, 2].min()
        if not press.weight and not 0 < depth <= most:
            raise SceneError(
                f"{press.name}: {depth:.3g} mm deep; allowed: up to {most:.3g} mm in {design.name}"
            )
    with several(processes) as workers:
        problem = Problem(design, presses, *_numerics(tier, device, workers or 1))
        values, errors, rounds = problem.descended(progress)
    names, markers, given = problem.names, tuple(errors.near.markers), tuple(problem.presses)
    result = names, errors.covariance, design, values, given, markers, errors.noise
    return GaugelessFit(*result, rounds, tier, device)


def marked_presses(observations: Sequence[MarkerObservations]) -> list[MarkedPress]:
    """Return the deepest presses of each mounting, `PRESSES` in all, until their tips go back."""
    presses: list[MarkedPress] = []
    tracks = list(dict.fromkeys(id(each.track) for each in observations))
    for each in observations:
        track, number = each.track, tracks.index(id(each.track))
        targets = track.target[each.rows]
        for target in np.unique(targets):
            own = np.flatnonzero(targets == target)
            tips = track.tip[each.rows[own]]
            count = 1 + int(np.linalg.norm(tips[:, :2] - tips[0, :2], axis=1).argmax())
            tip = np.concatenate([[[*tips[0, :2], ABOVE]], tips[:count]])
            press = f"{track.name}, press {target}", track.indenter, number, tip
            seen = each.undeformed, each.observed[own[:count]]
            presses.append(MarkedPress(*press, *seen, radius=each.radius))
    presses.sort(key=lambda press: float(press.tip[:, 2].min()))
    order = [press.mounting for press in presses]
    ranks = [order[:k].count(number) for k, number in enumerate(order)]
    return [presses[k] for k in np.argsort(ranks, kind="stable")[:PRESSES]]


def weighed_press(text: str, mounting: int) -> MarkedPress:
    """Return the press of a weight, from its mass or force and its marker archive, `200g=PATH`.

    The markers are the mean of the second half of the pictures under the weight.

    Raises:
        SceneError: The text is another, or the archive shows no weight.
    """
    form = re.fullmatch(r"\s*(\d*\.?\d+)\s*(g|kg|N)\s*=\s*(.+)", text)
    if form is None or not float(form[1]):
        allowed = "a mass or force above 0 in g, kg or N, and an archive: 200g=weight.markers.zarr"
        raise SceneError(f"weight: {text!r}; allowed: {allowed}")
    force = float(form[1]) * {"g": 1e-3 * GRAVITY, "kg": GRAVITY, "N": 1.0}[form[2]]
    archive = MarkerArchive(form[3])
    if len(archive) != 1:
        raise SceneError(f"{form[3]}: {len(archive)} sensors; allowed: one")
    (sensor,) = archive.values()
    rows = np.flatnonzero(sensor.table["valid"])
    rows = rows[np.argsort(sensor.table["t_ns"][rows], kind="stable")]
    follower = Follower.of(unpack(sensor.references[sensor.table["reference"][rows[0]]]), form[3])
    markers = follower.markers
    seen = np.array([follower.step(sensor.masks(rows[k : k + 1])[0]) for k in range(len(rows))])
    known = np.isfinite(seen[..., 0])
    square = np.nansum(np.square(seen - markers), axis=(1, 2)) / np.maximum(known.sum(axis=1), 1)
    under = np.flatnonzero(square > RESTS**2 * np.percentile(square, 95))
    resting = under[len(under) // 2 :]
    found = known[resting].mean(axis=0) > LOST if len(under) else known[0]
    if found.mean() < LOST or square.max() < 1.0:
        raise SceneError(
            f"{form[3]}: under the weight {100 * found.mean():.0f} % of the markers are found and "
            f"move by up to {math.sqrt(square.max()):.1f} px; allowed: {100 * LOST:.0f} %, 1 px"
        )
    observed = np.full_like(markers, np.nan)
    observed[found] = np.nanmean(seen[np.ix_(resting, found)], axis=0)
    indenter = archive.indenters[int(sensor.table["indenter"][rows[under[-1]]])]
    name = f"{form[1]} {form[2]} on {indenter}"
    tip, seen, radius = np.zeros((2, 3)), observed[None], follower.radius
    return MarkedPress(name, indenter, mounting, tip, markers, seen, force, radius)


def plan_without_gauge(
    design: SimulatedSensor, indenters: Sequence[str]
) -> tuple[list[PlannedPresses], tuple[str, float, float] | None]:
    """Return presses by smooth indenters, and a weight: indenter, mass [kg] and depth [m].

    The weight is the one that presses deepest of those that the skin bears, by tier `layer`.
    """
    smooth = [name for name in SMOOTH if name in indenters]
    if not smooth:
        raise SceneError(f"indenters: {', '.join(indenters)}; allowed: {', '.join(SMOOTH)}")
    thickness = design.body.thickness
    step, shear = round(min(PRESSED * thickness, design.depth_max) / 2, 5), SHEARED * thickness
    planned = [planned_presses(n, (step, 2 * step), round(shear, 5), HOLD) for n in smooth]
    depths = np.r_[0.0, np.linspace(0.02, BEARS, 12) * thickness]
    path = motion_of(np.column_stack([np.zeros((13, 2)), -depths]), np.arange(13.0))
    skin = replace(design, effects=Effects(), depth_max=0.9 * thickness)
    weights = []
    for name in smooth:
        force = -simulate(skin.scene(indenter_of(name), path), LAYER).force[:, 2]
        borne = [mass for mass in MASSES if GRAVITY * mass < force[-1]]
        weights += [(name, mass, float(np.interp(GRAVITY * mass, force, depths))) for mass in borne]
    return planned, max(weights, key=lambda each: each[2], default=None)
