"""Fit of a twin without a gauge: the skin from the motion of its markers, its scale from a weight.

How far markers move under a rigid tip at a known place depends on thickness, Poisson's ratio and
friction, not on the modulus. A known weight on a tip presses as deep as its markers show, and the
force of the skin there gives the modulus. Errors of the bench are unknowns with priors.
"""

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from recorder.archive import MarkerArchive
from recorder.markers import find_blobs, smallest_marker, unpack
from recorder.processes import several
from sim.arrays import Array, Progress
from sim.errors import SceneError, SimulationDiverged
from sim.fem import Fem
from sim.indenters import indenter_of
from sim.layer import Layer
from sim.markers.camera import HEIGHT, WIDTH
from sim.result import ContactTier, Result
from sim.scene import Effects, Scene
from sim.sensors import CameraSignal, Posterior, SimulatedSensor, SurfaceField
from sim.sensors.posterior import CAMERA, interval_of
from sim.sensors.quantities import camera_quantities, quantities, with_camera, with_quantities
from sim.tiers import simulate, simulate_many
from sim.twin.fit import PRIOR as PRIOR_WITH_GAUGE
from sim.twin.fit import UNIDENTIFIED, Uncertainty, Z, moved_by, way_of, with_effects
from sim.twin.markers import LOST, Follower, MarkerObservations
from sim.twin.model import leaning, motion_of, printed
from sim.twin.plan import PlannedPresses, planned_presses

# Prior spreads, as in `sim.twin.fit`. Names of what is of one mounting of an indenter end in `@`
# and its number.
PRIOR = {
    **PRIOR_WITH_GAUGE,
    **{"thickness": 0.3, "poisson": 0.03, "compliance": 7e-6, "turn": 0.026, "height": 30e-6},
    **{"place": 0.3e-3, "size": 0.1e-3, "mesh": 0.5},
    **{"scale": 0.005, "distance": 0.03, "shift": 12.0, "rotation": 0.026},
}
# The same of a weight that is laid by hand, about where its markers show it.
LAID = {"place": 1e-3, "height": 0.5e-3, "tilt": 0.05}
# Compliance of arm and mount in the middle of its prior [m/N].
COMPLIANCE = 8e-6
# Acceleration of free fall by which masses are weighed [m/s^2].
GRAVITY = 9.80665
SKIN, VIEW = ("thickness", "poisson", "friction"), CAMERA[:5]
# Quantities of a sensor that are fitted.
OF_SENSOR = ("modulus", *SKIN, *VIEW)
# Steps of derivatives that take a solution, of the skin and of a mounting, and of the others.
SKIN_STEPS = {"thickness": 0.05, "poisson": -0.01, "friction": 0.15}
OWN_STEPS = {"height": -30e-6, "tilt_x": 0.015, "tilt_y": 0.015, "size": 0.15e-3}
PLACE_STEPS = {"place_x": (1e-4, 0.0), "place_y": (0.0, 1e-4)}
VIEW_STEPS = {"scale": 0.01, "distance": 0.02, "shift_x": 3.0, "shift_y": 3.0, "rotation": 0.01}
# Mesh that follows the contact; fineness of a rougher one over it, whose difference is about the
# error of both; true markers beyond those of the finer one, over that difference, in the middle of
# the prior; longest step of the tip over the thickness.
FEM, ROUGHER, MESH = Fem(fineness=0.8, augmentations=1, tolerance=1e-3), 0.7, -0.5
TRAVEL = 0.05
# On a CPU the mesh is rougher: a round of seven presses then takes some three minutes of a core.
FEM_OF_CPU = replace(FEM, fineness=0.65)
LAYER = Layer(grid=64)
# Most presses of a fit, deepest one over the thickness, and height from which a tip comes [m].
PRESSES, DEEPEST, ABOVE = 8, 0.75, 50e-6
# Relative error of a force by the law, beside that of its mesh.
LAW = 0.015
# Most rounds, largest step that ends a fit in spreads of the result, longest step in spreads of the
# prior, by which a step is shortened that led nowhere, and from which it is given up.
ROUNDS, SMALL, LONGEST, SHORTER, SHORTEST = 8, 0.3, 2.0, 0.3, 0.1
# Length over which errors of the model are alike, over the thickness.
ALIKE = 0.5
# Least noise of a marker [px], least error of the model over the motion, and where both begin.
LEAST, BEGUN = (0.02, 0.01), (0.3, 0.03)
# Distance over the median one beyond which a marker is taken for another one.
WRONG = 10.0
# Depths over the thickness, and places [m], at which a weight is looked for.
DEPTHS, PLACES = np.linspace(0.06, 0.54, 9), np.linspace(-3e-3, 3e-3, 13)
# Smooth indenters, which have solutions on all skins; depth and way sideways of a plan over the
# thickness, and its holds [s].
SMOOTH, PRESSED, SHEARED, HOLD = ("sphere", "sphere_s", "hemisphere"), 0.27, 0.22, 1.0
# Usual masses [kg], and depth over the thickness up to which a skin bears one.
MASSES, BEARS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0), 0.35
# Part of the largest motion from which a weight rests on the tip.
RESTS = 0.8

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
    """Weight that presses [N]; 0 if an arm does."""


class Solution(NamedTuple):
    """Displacement of the markers' layer at each rest, and normal force over the modulus (f,)."""

    top: SurfaceField
    force: Array


class Near(NamedTuple):
    """A candidate: solutions, markers (f, m, 2) [px] and derivatives (f, m, 2, p) of each press."""

    values: dict[str, float]
    solutions: list[Solution]
    markers: list[Array]
    slopes: list[Array]
    of_force: list[Array]
    """Derivatives of the logarithm of the last force (p,)."""


@dataclass(frozen=True, slots=True, eq=False)
class GaugelessFit(Uncertainty):
    """Result of a fit without a gauge."""

    design: SimulatedSensor
    values: Mapping[str, float]
    presses: tuple[MarkedPress, ...]
    predicted: tuple[Array, ...]
    """Markers of the twin at the rests of each press (f, m, 2) [px]."""
    noise: tuple[float, float]
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
        return tuple(
            name
            for name in OF_SENSOR
            if spreads[name] > UNIDENTIFIED * PRIOR[name.partition("_")[0]]
        )

    @property
    def sensor(self) -> SimulatedSensor:
        """The twin with its camera and posterior; relaxation is the design's."""
        known = quantities(self.design)
        shown = ("modulus", *SKIN)
        twin = with_quantities(self.design, {name: self.values[name] for name in shown})
        twin = with_camera(twin, {name: self.values[name] for name in VIEW})
        relaxing = [name for name in known if name not in shown]
        rows = [self.names.index(name) for name in OF_SENSOR]
        count = len(rows)
        covariance = np.diag([0.0] * count + [PRIOR[name[:-2]] ** 2 for name in relaxing])
        covariance[:count, :count] = self.covariance[np.ix_(rows, rows)]
        arms = [press.mounting for press in self.presses if not press.weight]
        height = float(np.mean([self.values[f"height@{number}"] for number in arms]))
        names = (*OF_SENSOR, *relaxing)
        return replace(twin, posterior=Posterior.of(names, covariance, self.tier, height, LAW))

    def interval(self, name: str, z: float = Z) -> tuple[float, float]:
        """Return the interval of a quantity, 90 % by default."""
        return interval_of(name, self.values[name], z * self.spreads[name])

    def force_of(self, press: MarkedPress) -> tuple[float, float]:
        """Return the force [N] under which markers are as in a press that was not fitted.

        With the standard deviation of its logarithm.
        """
        rows = [self.names.index(name) for name in OF_SENSOR]
        solve = partial(solved_by, device=self.device)
        numerics = _numerics(self.tier, self.device)
        problem = Problem(self.design, [press], solve, numerics, weighs=False)
        count = len(rows)
        problem.precision[:count, :count] = np.linalg.inv(self.covariance[np.ix_(rows, rows)])
        problem.centre |= {name: self.values[name] for name in problem.names[:count]}
        ended = problem.descended()
        (solution,), (slope,) = ended.near.solutions, ended.near.of_force
        moved = [way_of(name, ended.near.values, ended.values) for name in problem.names]
        force = ended.near.values["modulus"] * float(solution.force[-1]) * math.exp(slope @ moved)
        return force, math.sqrt(slope @ ended.covariance @ slope + LAW**2)


class Ended(NamedTuple):
    """Where a descent ended, with a last step from the candidate `near` by its derivatives."""

    values: dict[str, float]
    near: Near
    covariance: Array
    noise: tuple[float, float]
    rounds: int


class Problem:
    """Presses to explain by the quantities of a skin, its camera and its bench.

    Weights are equations for the modulus if it `weighs`. Where one presses is looked for if its tip
    is not known: all 0.
    """

    def __init__(
        self,
        design: SimulatedSensor,
        presses: Sequence[MarkedPress],
        solve: Solve,
        tier: Fem | Layer,
        *,
        weighs: bool = True,
    ) -> None:
        if not isinstance(design.signal, CameraSignal):
            raise SceneError(f"{design.name}.signal: taxels; allowed: a camera")
        body = design.body
        self._signal = design.signal
        self._design = replace(
            design,
            trajectory=None,
            force_depth=None,
            depth_max=0.9 * body.thickness,
            effects=Effects(friction=design.effects.friction),
        )
        self._solve, self.weighs, self._tier = solve, weighs, tier
        own = (*PLACE_STEPS, "turn", *OWN_STEPS)
        numbers = dict.fromkeys(press.mounting for press in presses)
        self.names = (
            *(*OF_SENSOR, "compliance"),
            *(f"{name}@{number}" for number in numbers for name in own),
            *(f"mesh_{number}" for number in range(len(presses))),
        )
        known = {**quantities(design), **camera_quantities(design), "compliance": COMPLIANCE}
        self.centre = {name: known.get(name, 0.0) for name in self.names}
        laid = {str(press.mounting) for press in presses if press.weight}
        spreads = []
        for name in self.names:
            kind, _, number = name.partition("@")
            kind = kind.partition("_")[0]
            spreads.append(LAID[kind] if number in laid and kind in LAID else PRIOR[kind])
        self._spreads = np.array(spreads)
        self.precision = np.diag(self._spreads**-2)
        self.presses = [press if press.tip.any() else self._found(press) for press in presses]

    def _scene(
        self, press: MarkedPress, values: Mapping[str, float], force: Array | float = 0.0
    ) -> Scene:
        """Return the scene of a press whose mount yields by a force over the modulus (f,)."""
        at = {name: values[f"{name}@{press.mounting}"] for name in (*PLACE_STEPS, *OWN_STEPS)}
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
        """Return the solutions of scenes, None where there is none."""
        travel = TRAVEL * self._design.body.thickness
        tier = self._tier
        if isinstance(tier, Fem):
            tier = replace(tier, fineness=finer * tier.fineness, step_travel=travel)
        solved = list(self._solve(scenes, tier))
        failed = [k for k, each in enumerate(solved) if not isinstance(each, Result)]
        if failed and isinstance(tier, Fem):
            careful = replace(tier, step_travel=travel / 4, precision="float64")
            again = self._solve([scenes[k] for k in failed], careful)
            for k, each in zip(failed, again, strict=True):
                solved[k] = each
        return [self._solution(each) if isinstance(each, Result) else None for each in solved]

    def _solution(self, result: Result) -> Solution:
        top, pins = SurfaceField.of(result), self._signal.pins
        top = top if pins is None else pins.tips(top)
        force = np.maximum(-result.force[1:, 2], 1e-9) / result.scene.body.modulus
        return Solution(replace(top, displacement=top.displacement[1:]), force)

    def markers(
        self,
        press: MarkedPress,
        solution: Solution,
        values: Mapping[str, float],
        way: tuple[float, float] = (0.0, 0.0),
    ) -> Array:
        """Return the markers at each rest (f, m, 2) [px], the solution moved sideways (2,) [m]."""
        body = replace(self._design.body, thickness=values["thickness"])
        camera = replace(
            self._signal.camera(),
            focal=values["distance"] / values["scale"],
            distance=values["distance"],
            shift=(values["shift_x"], values["shift_y"]),
            rotation=values["rotation"],
        )
        flat = camera.places(press.undeformed, body)
        angle = values[f"turn@{press.mounting}"]
        turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        moved = solution.top.at(flat @ turn - np.array(way))
        moved[..., :2] = moved[..., :2] @ turn.T
        return camera.project(np.column_stack([flat, body.heights_at(*flat.T)]) + moved)

    def _found(self, press: MarkedPress) -> MarkedPress:
        """Return a weight's press at the depth and place that its markers show on the design."""
        path = np.zeros((len(DEPTHS) + 1, 3))
        path[:, 2] = np.r_[ABOVE, -DEPTHS * self._design.body.thickness]
        (solution,) = self._solved([self._scene(replace(press, tip=path), self.centre)])
        if solution is None:
            raise SimulationDiverged(f"{press.name}: no solution for {press.indenter}")
        tried = []
        for x in PLACES:
            for y in PLACES:
                off = self.markers(press, solution, self.centre, (x, y)) - press.observed[-1]
                square = np.nanmedian(np.square(off).sum(axis=-1), axis=-1)
                tried.append((float(square.min()), x, y, path[1 + square.argmin(), 2]))
        _, x, y, z = min(tried)
        return replace(press, tip=np.array([[x, y, ABOVE], [x, y, z]]))

    def offset(self, values: Mapping[str, float]) -> Array:
        """Return the way from the prior's centre to values (p,)."""
        return np.array([way_of(name, self.centre, values) for name in self.names])

    def _near(self, values: Mapping[str, float], forces: Sequence[Array]) -> Near | None:
        """Return markers and derivatives at values, None if a press has no solution there."""
        due: list[tuple[int, str, Mapping[str, float]]] = []
        for k, press in enumerate(self.presses):
            own = {f"{name}@{press.mounting}": step for name, step in OWN_STEPS.items()}
            steps = {**SKIN_STEPS, **own}.items()
            due.append((k, "", values))
            due += [(k, name, {**values, name: moved_by(name, values, by)}) for name, by in steps]
        solved = self._solved([self._scene(self.presses[k], at, forces[k]) for k, _, at in due])
        found = list(zip(due, solved, strict=True))
        solutions = [there for (_, name, _), there in found if not name]
        known = [each for each in solutions if each is not None]
        if len(known) < len(solutions):
            return None
        near = Near(dict(values), known, [], [], [])
        for k, (press, solution) in enumerate(zip(self.presses, known, strict=True)):
            markers = self.markers(press, solution, values)
            slopes = {name: np.zeros_like(markers) for name in self.names}
            force = dict.fromkeys(self.names, 0.0) | {"modulus": 1.0}
            for (of, name, moved), there in found:
                if of == k and name and there is not None:
                    way = way_of(name, values, moved)
                    slopes[name] = (self.markers(press, there, moved) - markers) / way
                    force[name] = math.log(there.force[-1] / solution.force[-1]) / way
            for name, along in PLACE_STEPS.items():
                there_markers = self.markers(press, solution, values, along)
                slopes[f"{name}@{press.mounting}"] = (there_markers - markers) / max(along)
            for name, step in {**VIEW_STEPS, f"turn@{press.mounting}": 0.01}.items():
                moved = {**values, name: moved_by(name, values, step)}
                way = way_of(name, values, moved)
                slopes[name] = (self.markers(press, solution, moved) - markers) / way
            if not press.weight:
                # The mount yields by compliance times force, as if the surface were lower.
                lower = -values["modulus"] * solution.force[:, None, None]
                slopes["compliance"] = slopes[f"height@{press.mounting}"] * lower
                slopes["modulus"] = slopes["compliance"] * values["compliance"]
            near.markers.append(markers)
            near.slopes.append(np.stack([slopes[name] for name in self.names], axis=-1))
            near.of_force.append(np.array([force[name] for name in self.names]))
        return near

    def descended(self, progress: Progress = lambda fraction: None) -> Ended:
        """Return where the quantities explain the presses best, begun at the prior's centre.

        Raises:
            SceneError: A tip is nearly through the skin.
            SimulationDiverged: A press has no solution.
        """
        forces = [solution.force for solution in self._begun()]
        values, part = self.centre, 1.0
        errors: Errors | None = None
        for done in range(1, ROUNDS + 1):
            progress(done / (ROUNDS + 1))
            near = self._near(values, forces)
            gained = math.inf
            if near is not None and errors is not None:
                gained = errors.least - errors.cost(near.values, near.solutions)
            if near is not None and gained > 0:
                forces = [solution.force for solution in near.solutions]
                errors, part = Errors(self, near), 1.0
                step, covariance = errors.step()
                small = np.abs(step) < SMALL * np.sqrt(np.diag(covariance))
                if small[: len(OF_SENSOR)].all() or gained < SMALL:
                    break
                step = np.clip(step, -LONGEST * self._spreads, LONGEST * self._spreads)
            elif errors is None or part < SHORTEST:
                break
            else:
                part *= SHORTER
            moves = zip(self.names, part * step, strict=True)
            values = {name: moved_by(name, errors.near.values, by) for name, by in moves}
        if errors is None:
            raise SimulationDiverged(f"{self.presses[0].name}: no solution near that of the design")
        self._add_mesh(errors.near)
        errors = Errors(self, errors.near)
        step, covariance = errors.step()
        moves = zip(self.names, step, strict=True)
        values = {name: moved_by(name, errors.near.values, by) for name, by in moves}
        most = min(self._design.depth_max, 0.9 * values["thickness"])
        for press in self.presses:
            depth = values[f"height@{press.mounting}"] - float(press.tip[:, 2].min())
            if depth > most:
                raise SceneError(
                    f"{press.name}: the fit has the tip {1e3 * depth:.2f} mm deep; allowed: up to "
                    f"{1e3 * most:.2f} mm, 90 % of the thickness: press less, or lay less weight"
                )
        return Ended(values, errors.near, covariance, errors.noise, done)

    def _add_mesh(self, near: Near) -> None:
        """Add the derivatives by the error of the mesh, and the middle of its prior."""
        self.centre |= {name: MESH for name in self.names if name.startswith("mesh")}
        pairs = list(zip(self.presses, near.solutions, strict=True))
        scenes = [self._scene(press, near.values, solution.force) for press, solution in pairs]
        for k, there in enumerate(self._solved(scenes, ROUGHER)):
            if there is not None:
                column = self.names.index(f"mesh_{k}")
                off = self.markers(self.presses[k], there, near.values) - near.markers[k]
                near.slopes[k][..., column] = off
                near.of_force[k][column] = math.log(there.force[-1] / near.solutions[k].force[-1])

    def _begun(self) -> list[Solution]:
        """Return the solutions at the prior's centre, of a rigid mount."""
        scenes = [self._scene(press, self.centre) for press in self.presses]
        begun = [each for each in self._solved(scenes) if each is not None]
        if len(begun) < len(scenes):
            names = ", ".join(press.name for press in self.presses)
            raise SimulationDiverged(f"one of {names} has no solution; allowed: leave it out")
        return begun

    def expected(self) -> Uncertainty:
        """Return the uncertainty to expect if the prior's centre is true."""
        near = self._near(self.centre, [solution.force for solution in self._begun()])
        if near is None:
            raise SimulationDiverged(f"{self.presses[0].name}: a press has no solution")
        pairs = zip(self.presses, near.markers, strict=True)
        self.presses = [replace(press, observed=markers) for press, markers in pairs]
        return Uncertainty(self.names, Errors(self, near, BEGUN).step()[1])


class Errors:
    """Residuals of presses along axes in which their errors are independent.

    Each marker has a noise of its own. Errors of the model are in proportion to the motion, and
    alike in markers that are near one another. Weights have the error of the law.
    """

    def __init__(
        self, problem: Problem, near: Near, noise: tuple[float, float] | None = None
    ) -> None:
        self._problem, self.near, values = problem, near, near.values
        presses = problem.presses
        sizes = [
            np.linalg.norm(press.observed - markers, axis=-1)
            for press, markers in zip(presses, near.markers, strict=True)
        ]
        most = max(1.0, WRONG * float(np.nanmedian(np.concatenate([s.ravel() for s in sizes]))))
        reach = ALIKE * values["thickness"] / values["scale"]
        self._rests: list[tuple[int, int, NDArray[np.bool_], Array]] = []
        variances = []
        for k, press in enumerate(presses):
            apart = np.linalg.norm(press.undeformed[:, None] - press.undeformed, axis=-1)
            for rest, size in enumerate(sizes[k]):
                known = size < most  # False where one was not found
                moved = np.linalg.norm(near.markers[k][rest] - press.undeformed, axis=-1)
                alike = np.exp(-apart / reach) * np.outer(moved, moved)
                lengths, axes = np.linalg.eigh(alike[np.ix_(known, known)])
                self._rests.append((k, rest, known, axes))
                variances.append(np.repeat(np.maximum(lengths, 0.0), 2))
        self._alike = np.concatenate(variances)
        self._residual = self._off(near.solutions, near.markers, values)
        self._offset = problem.offset(values)
        forces = [near.of_force[k][None] for k, press in self._weights()]
        self._slopes = np.concatenate([self._turned(near.slopes), *forces])
        rests = Counter(presses[k].mounting for k, *_ in self._rests)
        self._shared = math.sqrt((max(rests.values()) + 1) / 2)
        self.noise = noise or self._likeliest()
        self.least = self._squares(self._residual, self._offset)

    def _weights(self) -> list[tuple[int, MarkedPress]]:
        pairs = enumerate(self._problem.presses)
        return [(k, press) for k, press in pairs if press.weight and self._problem.weighs]

    def _turned(self, arrays: Sequence[Array]) -> Array:
        """Return values of markers (f, m, 2, ...) of every press along the axes (r, ...)."""
        parts = []
        for k, rest, known, axes in self._rests:
            values = arrays[k][rest][known]
            along = axes.T @ values.reshape(len(values), -1)
            parts.append(along.reshape(-1, *values.shape[2:]))
        return np.concatenate(parts)

    def _off(
        self, solutions: Sequence[Solution], markers: Sequence[Array], values: Mapping[str, float]
    ) -> Array:
        """Return the residuals (r + w,): of markers [px], and of logarithms of weights."""
        pairs = zip(self._problem.presses, markers, strict=True)
        forces = [
            math.log(press.weight / (values["modulus"] * solutions[k].force[-1]))
            for k, press in self._weights()
        ]
        off = self._turned([press.observed - each for press, each in pairs])
        return np.asarray(np.r_[off, forces])

    def _information(self, noise: tuple[float, float]) -> tuple[Array, Array]:
        """Return inverse variances of residuals (r + w,), and the inverse covariance (p, p)."""
        sure = 1 / (noise[0] ** 2 + noise[1] ** 2 * self._alike)
        sure = np.r_[sure, [LAW**-2] * len(self._weights())]
        return sure, self._slopes.T @ (sure[:, None] * self._slopes) + self._problem.precision

    def step(self, noise: tuple[float, float] | None = None) -> tuple[Array, Array]:
        """Return the step (p,) to the least cost, and the covariance there (p, p)."""
        # Noise of the image without contact is common to all rests of a mounting.
        sure, normal = self._information(noise or (self._shared * self.noise[0], self.noise[1]))
        downhill = self._slopes.T @ (sure * self._residual) - self._problem.precision @ self._offset
        covariance = np.asarray(np.linalg.inv(normal))
        return np.asarray(covariance @ downhill), covariance

    def cost(self, values: Mapping[str, float], solutions: Sequence[Solution]) -> float:
        """Return the squares of residuals, and of the way from the prior, in standard errors."""
        problem = self._problem
        pairs = zip(problem.presses, solutions, strict=True)
        markers = [problem.markers(press, solution, values) for press, solution in pairs]
        return self._squares(self._off(solutions, markers, values), problem.offset(values))

    def _squares(self, residual: Array, offset: Array) -> float:
        sure = self._information(self.noise)[0]
        return float(sure @ np.square(residual) + offset @ self._problem.precision @ offset)

    def _likeliest(self) -> tuple[float, float]:
        """Return the errors under which residuals are likeliest, quantities unknown (REML)."""

        def errors(logs: Array) -> tuple[float, float]:
            marker, model = np.maximum(np.exp(logs), LEAST).tolist()
            return marker, model

        def unlikely(logs: Array) -> float:
            sure, normal = self._information(errors(logs))
            step, _ = self.step(errors(logs))
            left, offset = self._residual - self._slopes @ step, self._offset + step
            cost = sure @ np.square(left) + offset @ self._problem.precision @ offset
            return float(cost + np.linalg.slogdet(normal)[1] - np.log(sure).sum())

        how = {"maxfev": 60, "xatol": 0.03, "fatol": 0.1}
        return errors(minimize(unlikely, np.log(BEGUN), method="Nelder-Mead", options=how).x)


def _numerics(tier: ContactTier, device: str) -> Fem | Layer:
    if tier == "layer":
        return LAYER
    return FEM_OF_CPU if device == "cpu" else FEM


def solved_by(
    scenes: Sequence[Scene], tier: Fem | Layer, *, device: str, processes: Any = 1
) -> list[Any]:
    """Return the outcomes of scenes; a GPU solves those of one indenter in one launch."""
    if device == "cpu" or isinstance(tier, Layer):
        return simulate_many(scenes, tier, device=device, processes=processes)
    outcomes: dict[int, Any] = {}
    for name in dict.fromkeys(scene.indenter.name for scene in scenes):
        own = [k for k, scene in enumerate(scenes) if scene.indenter.name == name]
        every = simulate_many(
            [scenes[k] for k in own], replace(tier, one_topology=True), device=device
        )
        outcomes |= zip(own, every, strict=True)
    return [outcomes[k] for k in range(len(scenes))]


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
    design = with_effects(design)
    most = DEEPEST * design.body.thickness
    if all(press.weight for press in presses):
        raise SceneError("presses: none by an arm; allowed: at least one at a known place")
    for press in presses:
        if not press.weight and not 0 < -press.tip[:, 2].min() <= most:
            raise SceneError(
                f"{press.name}: {-1e3 * press.tip[:, 2].min():.3g} mm deep; allowed: up to "
                f"{1e3 * most:.3g} mm in {design.name}"
            )
    with several(processes) as workers:
        solve = partial(solved_by, device=device, processes=workers or 1)
        problem = Problem(design, presses, solve, _numerics(tier, device))
        ended = problem.descended(progress)
    return GaugelessFit(
        names=problem.names,
        covariance=ended.covariance,
        design=design,
        values=ended.values,
        presses=tuple(problem.presses),
        predicted=tuple(ended.near.markers),
        noise=ended.noise,
        rounds=ended.rounds,
        tier=tier,
        device=device,
    )


def marked_presses(observations: Sequence[MarkerObservations]) -> list[MarkedPress]:
    """Return the deepest presses of each mounting, `PRESSES` in all, until their tips go back."""
    presses = []
    tracks = list({id(each.track): None for each in observations})
    for each in observations:
        track = each.track
        for target in np.unique(track.target[each.rows]):
            own = np.flatnonzero(track.target[each.rows] == target)
            tips = track.tip[each.rows[own]]
            count = 1 + int(np.linalg.norm(tips[:, :2] - tips[0, :2], axis=1).argmax())
            tip = np.concatenate([[[*tips[0, :2], ABOVE]], tips[:count]])
            press = MarkedPress(
                f"{track.name}, press {target}",
                track.indenter,
                tracks.index(id(track)),
                tip,
                each.undeformed,
                each.observed[own[:count]],
            )
            presses.append(press)
    presses.sort(key=lambda press: float(press.tip[:, 2].min()))
    before: Counter[int] = Counter()
    ranks = []
    for press in presses:
        ranks.append(before[press.mounting])
        before[press.mounting] += 1
    return [presses[k] for k in np.argsort(ranks, kind="stable")[:PRESSES]]


def weighed_press(text: str, mounting: int) -> MarkedPress:
    """Return the press of a weight, from its mass or force and its marker archive, `200g=PATH`.

    The markers are the mean of the second half of the pictures under the weight.

    Raises:
        SceneError: The text is another, or the archive shows no weight.
    """
    form = re.fullmatch(r"\s*([0-9.]+)\s*(g|kg|N)\s*=\s*(.+)", text)
    value = float(form[1]) if form and re.fullmatch(r"\d*\.?\d+", form[1]) else 0.0
    if form is None or not value > 0:
        raise SceneError(
            f"weight: {text!r}; allowed: a mass or force above 0 with its unit, g, kg or N, and "
            "the marker archive of its pictures, such as 200g=weight.markers.zarr"
        )
    force = value * {"g": 1e-3 * GRAVITY, "kg": GRAVITY, "N": 1.0}[form[2]]
    archive = MarkerArchive(form[3])
    if len(archive) != 1:
        raise SceneError(f"{form[3]}: {len(archive)} sensors; allowed: one")
    (sensor,) = archive.values()
    rows = np.flatnonzero(sensor.table["valid"])
    rows = rows[np.argsort(sensor.table["t_ns"][rows], kind="stable")]
    mask = unpack(sensor.references[sensor.table["reference"][rows[0]]])
    blobs = find_blobs(mask[None], smallest_marker(mask))
    markers = blobs.centre[blobs.whole]
    follower = Follower(markers, float(np.median(blobs.area)))
    seen = np.array([follower.step(sensor.masks(rows[k : k + 1])[0]) for k in range(len(rows))])
    known = np.isfinite(seen[..., 0])
    square = np.nansum(np.square(seen - markers), axis=(1, 2)) / np.maximum(known.sum(axis=1), 1)
    under = np.flatnonzero(square > RESTS**2 * np.percentile(square, 95))
    resting = under[len(under) // 2 :]
    found = known[resting].mean(axis=0) > LOST if len(under) else known[0]
    if found.mean() < LOST or square.max() < 1.0:
        raise SceneError(
            f"{form[3]}: under the weight {100 * found.mean():.0f} % of the markers are found and "
            f"move by up to {math.sqrt(square.max()):.1f} px; allowed: {100 * LOST:.0f} % or more, "
            "1 px or more"
        )
    observed = np.full_like(markers, np.nan)
    observed[found] = np.nanmean(seen[np.ix_(resting, found)], axis=0)
    indenter = archive.indenters[int(sensor.table["indenter"][rows[under[-1]]])]
    name = f"{form[1]} {form[2]} on {indenter}"
    return MarkedPress(name, indenter, mounting, np.zeros((2, 3)), markers, observed[None], force)


def expected_without_gauge(
    design: SimulatedSensor, planned: Sequence[PlannedPresses], weight: tuple[str, float] | None
) -> Uncertainty:
    """Return the uncertainty to expect after presses, and a weight on an indenter to a depth [m].

    The design is taken as true, by tier `layer`; its markers are those of its pattern.
    """
    design = with_effects(design)
    if not isinstance(design.signal, CameraSignal):
        raise SceneError(f"{design.name}.signal: taxels; allowed: a camera")
    flat = design.signal.drawn()[0].centres
    points = np.column_stack([flat, design.body.heights_at(*flat.T)])
    pixels = design.signal.camera().project(points)
    seen = pixels[((pixels > 0) & (pixels < (WIDTH, HEIGHT))).all(axis=1)]
    down = np.array([0.0, 0.0, -1.0])
    due = [
        (each.indenter, number, [0 * down, depth * down, [each.plan.shear, 0.0, -depth]], 0.0)
        for number, each in enumerate(planned)
        for depth in each.depths
    ]
    if weight is not None:
        due.append((weight[0], len(planned), [0 * down, weight[1] * down], 1.0))
    presses = [
        MarkedPress(name, name, number, np.array(tip), seen, np.zeros((0, *seen.shape)), force)
        for name, number, tip, force in due
    ]
    return Problem(design, presses, simulate_many, LAYER).expected()


def plan_without_gauge(
    design: SimulatedSensor, indenters: Sequence[str]
) -> tuple[list[PlannedPresses], tuple[str, float, float] | None]:
    """Return presses by smooth indenters, and a weight: indenter, mass [kg] and depth [m].

    The weight is the one that presses deepest of those that the skin bears.
    """
    smooth = [name for name in SMOOTH if name in indenters]
    if not smooth:
        raise SceneError(f"indenters: {', '.join(indenters)}; allowed: {', '.join(SMOOTH)}")
    thickness = design.body.thickness
    step = round(min(PRESSED * thickness, design.depth_max) / 2, 5)
    planned = [
        planned_presses(name, (step, 2 * step), round(SHEARED * thickness, 5), HOLD)
        for name in smooth
    ]
    depths = np.r_[0.0, np.linspace(0.02, BEARS, 12) * thickness]
    path = motion_of(np.column_stack([np.zeros((13, 2)), -depths]), np.arange(13.0))
    skin = replace(design, effects=Effects(), depth_max=0.9 * thickness)
    weights = []
    for name in smooth:
        force = -simulate(skin.scene(indenter_of(name), path), LAYER).force[:, 2]
        for mass in MASSES:
            if GRAVITY * mass < force[-1]:
                weights.append((name, mass, float(np.interp(GRAVITY * mass, force, depths))))
    return planned, max(weights, key=lambda each: each[2], default=None)
