"""Solver of the `layer` tier: linear elastic, a few milliseconds per step."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.arrays import Progress
from sim.errors import SceneError, SimulationDiverged
from sim.layer import Layer
from sim.layer.contact import Clearance, Contact, solve_frictional, solve_frictionless
from sim.layer.spectral import PixelGrid, convolutions
from sim.result import Quality, Result, dumped, no_quality, width_of
from sim.scene import Scene, Viscosity

# History of a relaxing layer: the stress in its Maxwell branches, per pixel.

Array = NDArray[np.floating[Any]]


@dataclass(frozen=True, slots=True)
class Relaxed:
    """Relation of a step's traction to its elastic part: factor * elastic + held."""

    factor: float
    held: Array
    """Traction from the history (3, X, Y) [Pa]."""
    decay: tuple[float, ...]
    """Fraction of each branch's stress that remains after the step."""
    gained: tuple[float, ...]
    """Fraction of a change in the elastic part that each branch takes up."""


class History:
    """Tractions of a layer that relaxes in the same way for all deformations.

    With E(t) = E (1 + sum_i ratio_i exp(-t / time_i)) and a constant Poisson's ratio, the traction
    is that of the elastic layer with the current displacement, `elastic`, plus one convolution per
    branch of its change with ratio_i exp(-t / time_i). `elastic` changes linearly within a step.
    For that the convolution is exact (Taylor, Pister & Goudreau, Int. J. Numer. Meth. Eng. 2
    (1970) 45).
    """

    def __init__(self, viscosity: Viscosity | None, shape: tuple[int, int]) -> None:
        """Begin at rest and undeformed; without viscosity there is no history."""
        self._ratios = viscosity.ratios if viscosity else ()
        self._times = viscosity.times if viscosity else ()
        self.elastic: Array = np.zeros((3, *shape))
        """Traction that the elastic layer would need for the current displacement [Pa]."""
        self._tractions: list[Array] = [np.zeros((3, *shape)) for _ in self._ratios]

    def after(self, duration: float) -> Relaxed:
        """Return the relation of traction to elastic part after `duration` [s]; 0 is a jump."""
        spans = [duration / time for time in self._times]
        decay = tuple(math.exp(-span) for span in spans)
        gained = tuple(
            ratio * (-math.expm1(-span) / span if span > 0 else 1.0)
            for ratio, span in zip(self._ratios, spans, strict=True)
        )
        held = np.zeros_like(self.elastic) - sum(gained) * self.elastic
        for fraction, branch in zip(decay, self._tractions, strict=True):
            held += fraction * branch
        return Relaxed(1 + sum(gained), held, decay, gained)

    def take(self, step: Relaxed, elastic: Array) -> None:
        """End a step with this elastic part."""
        change = elastic - self.elastic
        self._tractions = [
            fraction * branch + gain * change
            for fraction, gain, branch in zip(step.decay, step.gained, self._tractions, strict=True)
        ]
        self.elastic = elastic

    def branches(self) -> list[tuple[float, Array]]:
        """Return stiffness over that at rest, and traction [Pa], of each branch with stiffness."""
        return [
            (ratio, traction)
            for ratio, traction in zip(self._ratios, self._tractions, strict=True)
            if ratio > 0
        ]


# A layer under an indenter: its state, and the steps that advance it.

# Longest step in radii of the contact. Within a step every pixel is assumed to slide and relax
# evenly, even if it is touched half-way; halving the step halves that error. At 0.1 a sphere's
# shear forces are off by 0.1, 0.3, 1.5 % of their peak with friction 0.3, 0.8, 3, compared with
# steps 20 times as short.
TRAVEL = 0.1
# Longest step in pixels, if the contact is small.
TRAVEL_LEAST = 0.5
# Most times that a step that does not converge is halved.
HALVINGS = 4
# Fraction of the overlap by which the skin may rise next to the contact and touch elsewhere.
BULGE = 0.2
# Window sizes are multiples of this many pixels, so that few sizes occur.
BLOCK = 8
# Least tolerance for single precision, which reaches about 1e-5.
SINGLE = 1e-3
# Overlap outside of the window, over the tip's depth, that is tolerated.
OVERLAP = 1e-2


def precision(tolerance: float) -> type[np.floating[Any]]:
    """Return the precision of contacts: single if it can reach the tolerance."""
    return np.float32 if tolerance >= SINGLE else np.float64


def _product(one: Array, other: Array) -> float:
    """Return the sum of products of two fields, on one thread: more threads would be slower."""
    return float(np.einsum("kij,kij->", one, other, dtype=np.float64))


@dataclass(slots=True)
class MoveCost:
    """Cost of moves."""

    iterations: int = 0
    steps: int = 0


def failed_step(travel: float, iterations: int, residual: float, tolerance: float) -> str:
    """Return a step of some length [m] that did not converge, in words."""
    return (
        f"step of {travel * 1e3:.4g} mm, {iterations} iterations, residual {residual:.2e} "
        f"(allowed {tolerance:.2e})"
    )


def diverged_at(
    scene: Scene, tip: Array, traction: Array, displacement: Array, tried: Sequence[str]
) -> SimulationDiverged:
    """Return the error of a step from the tip at (3,) [m] that failed, with the state in a file.

    That has the traction (3, nx, ny) [Pa] and the displacement (3, nx, ny) [m] before the step.
    """
    dump = dumped(scene=repr(scene), tip=tip, traction=traction, displacement=displacement)
    x, y, z = tip * 1e3
    return SimulationDiverged(
        f"no converged state after the tip at ({x:.4g}, {y:.4g}, {z:.4g}) mm: "
        f"{len(tried)} steps failed, the last: {tried[-1]}; state: "
        f"{dump or 'could not be written'}",
        tried=tuple(tried),
        dump=dump,
    )


class LayerPress:
    """Layer of one scene, moved step by step; `traction` and `displacement` are its state."""

    def __init__(self, scene: Scene, grid: PixelGrid, tolerance: float) -> None:
        """Start undeformed, with the tip above the first waypoint."""
        effects = scene.effects
        self._scene = scene
        self.grid = grid
        self.traction: Array = np.zeros((3, *grid.shape))
        """Traction of the indenter on the body (3, nx, ny) [Pa]."""
        self.history = History(effects.viscosity, grid.shape)
        x, y, z = scene.motion.tip[0]
        self.tip = np.array([x, y, max(z, 0.0)])
        """Position of the tip [m]."""
        self.residual = 0.0
        """Residual of the last step's contact."""
        self.work = 0.0
        """Work of the indenter so far, by the trapezoid rule [J]."""
        self.spent = MoveCost()
        self._tolerance = tolerance
        self._rubs = effects.friction is not None
        self._coefficient = effects.friction.coefficient if effects.friction else 0.0
        self._clearance = Clearance(scene.indenter, grid, scene.motion)
        self._clear, self._extra = self._clearance.at(self.tip)  # above the undeformed body
        self._convolutions = convolutions(grid, np.dtype(precision(tolerance)))
        self._tried: list[str] = []
        self.displacement: Array = np.zeros((3, *grid.shape), np.float32)
        """Displacement of the top (3, nx, ny) [m]."""

    @property
    def force(self) -> Array:
        """Force of the indenter on the body (3,) [N]."""
        return np.asarray(self.traction.sum(axis=(1, 2)) * self.grid.area)

    @property
    def gap(self) -> Array:
        """Gap between indenter and body (nx, ny) [m]; negative: overlap."""
        gap: Array = (
            self._clear - self.displacement[2] - self._extra_displacement(self.history.elastic)[2]
        )
        return gap

    @property
    def wrench(self) -> Array:
        """Force and torque about the tip of the indenter on the body (6,) [N, N m]."""
        touched = self.traction.any(axis=0)
        row, column = np.nonzero(touched)
        undeformed = np.stack(
            [self.grid.x[row], self.grid.y[column], self._clearance.surface[touched]]
        )
        lever = undeformed + self.displacement[:, touched] - self.tip[:, None]
        push = self.traction[:, touched] * self.grid.area
        return np.concatenate([push.sum(axis=1), np.cross(lever, push, axis=0).sum(axis=1)])

    @property
    def slip_excess(self) -> float:
        """Largest shear in excess of friction over the largest pressure; NaN without friction."""
        pressure = -self.traction[2]
        if not self._rubs or not pressure.any():
            return 0.0 if self._rubs else math.nan
        shear = np.hypot(self.traction[0], self.traction[1])
        return float((shear - self._coefficient * pressure).max() / pressure.max())

    @property
    def energy(self) -> float:
        """Energy stored in all springs [J]."""
        elastic = self.history.elastic
        rest = _product(elastic, self.displacement + self._extra_displacement(elastic))
        branches = (
            _product(traction, self._moved_by(traction) + self._extra_displacement(traction))
            / stiffness
            for stiffness, traction in self.history.branches()
        )
        return 0.5 * self.grid.area * (rest + sum(branches))

    def move(self, tip: Array, duration: float) -> None:
        """Move the tip straight to `tip` (3,) [m] in `duration` [s], in as many steps as needed."""
        start, left = self.tip, 1.0
        length = float(np.linalg.norm(tip - start))
        while left > 0:
            fraction = min(left, self._longest(tip) / length) if length > 0 else left
            fraction = left / math.ceil(left / fraction - 1e-9)
            left = left - fraction if fraction < left else 0.0
            self._step_or_halve(tip + (start - tip) * left, duration * fraction, 0)

    def _longest(self, tip: Array) -> float:
        """Return the longest next step on the way to `tip` [m]."""
        radius = math.sqrt(np.count_nonzero(self.traction[2]) * self.grid.area / math.pi)
        longest = max(TRAVEL * radius, TRAVEL_LEAST * min(self.grid.pixel))
        if radius == 0:
            here = float(self.gap.min())
            there = float((self._clearance.at(tip)[0] - self.displacement[2]).min())
            free = 1.0 if there >= 0 else max(0.0, here) / (max(0.0, here) - there)
            longest = max(longest, free * float(np.linalg.norm(tip - self.tip)))
        return longest

    def _step_or_halve(self, tip: Array, duration: float, halvings: int) -> None:
        self._tried = self._tried if halvings else []
        if self._step(tip, duration):
            return
        if halvings == HALVINGS:
            raise diverged_at(self._scene, self.tip, self.traction, self.displacement, self._tried)
        middle = (self.tip + tip) / 2
        self._step_or_halve(middle, duration / 2, halvings + 1)
        self._step_or_halve(tip, duration / 2, halvings + 1)

    def _step(self, tip: Array, duration: float) -> bool:
        """Attempt a step and return True if it converged; if not, the state is unchanged."""
        gap, extra = self._clearance.at(tip)
        relaxed = self.history.after(duration)
        touching = self.history.elastic.any(axis=0)
        touching |= gap < BULGE * max(0.0, -float(gap.min()))
        while True:
            window = self._window(touching)
            contact = self._solve(window, gap, extra, tip, relaxed)
            self.spent.steps += 1
            self.spent.iterations += contact.iterations
            if not contact.residual <= self._tolerance:
                travel = float(np.linalg.norm(tip - self.tip))
                self._tried.append(
                    failed_step(travel, contact.iterations, contact.residual, self._tolerance)
                )
                return False
            traction = np.zeros_like(self.traction)
            traction[window] = contact.traction
            elastic = (traction - relaxed.held) / relaxed.factor
            displacement = self._moved_by(elastic)
            missed = gap - displacement[2] < -OVERLAP * abs(tip[2])
            missed[window[1:]] = False
            if not missed.any():
                break
            touching |= missed
        before = self.force
        self.traction, self.displacement = traction, displacement
        self.history.take(relaxed, elastic)
        self.work += 0.5 * float((before + self.force) @ (tip - self.tip))
        self.tip, self.residual = tip, contact.residual
        self._clear, self._extra = gap, extra
        return True

    def _solve(
        self, window: tuple[slice, ...], gap: Array, extra: Array, tip: Array, relaxed: Relaxed
    ) -> Contact:
        """Solve the elastic contact problem equivalent to the step's relaxing one.

        With traction = factor * elastic + held, the gap is gap - C (traction - held) / factor: that
        of an elastic layer, all lengths multiplied by the factor.
        """
        dtype = self._convolutions.dtype
        elastic = self.history.elastic[window].astype(dtype)
        held = relaxed.held[window].astype(dtype)
        away = (relaxed.factor * gap[window[1:]]).astype(dtype)
        body = self._convolutions.within(away.shape).yielding(extra[window[1:]].astype(dtype))
        relief = body.answer.full(held) if held.any() else np.zeros_like(held)
        away += relief[2]
        # Initial guess: an unchanged displacement.
        start = relaxed.factor * elastic + held
        if not self._coefficient:
            return solve_frictionless(body, away, start, tolerance=self._tolerance)
        travel = (tip - self.tip)[:2, None, None].astype(dtype)
        slip = -relaxed.factor * (body.answer.full(elastic)[:2] + travel) - relief[:2]
        return solve_frictional(
            body, away, slip, self._coefficient, start, tolerance=self._tolerance
        )

    def _extra_displacement(self, elastic: Array) -> Array:
        """Return how much partly covered pixels yield more by a traction (3, nx, ny) [m]."""
        local = self._convolutions.within((1, 1))
        factors = np.array([local.local_shear, local.local_shear, local.local_normal])
        return factors[:, None, None] * self._extra * elastic

    def _moved_by(self, elastic: Array) -> Array:
        return self._convolutions.whole.full(elastic.astype(np.float32))

    def _window(self, touching: NDArray[np.bool_]) -> tuple[slice, ...]:
        """Return the block of pixels to solve on, as slices of (3, nx, ny)."""
        window: list[slice] = [slice(None)]
        for axis in range(2):
            size = self.grid.shape[axis]
            used = np.flatnonzero(touching.any(axis=1 - axis))
            first, last = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, 1)
            wide = min(size, BLOCK * math.ceil((last - first + 2) / BLOCK))
            low = min(max(0, (first + last - wide) // 2), size - wide)
            window.append(slice(low, low + wide))
        return tuple(window)


# Values kept at each waypoint of a press: force, surface, and quality measures.


class LayerFrames:
    """Frames of one press, filled one after the other.

    `balance` stays NaN: base and top are in balance wave by wave, so there is no difference.
    """

    def __init__(self, scene: Scene, press: LayerPress) -> None:
        """Allocate a frame for each waypoint."""
        self._scene, self._press = scene, press
        count = len(scene.motion)
        self._wrench = np.zeros((count, 6))
        self._surface = np.zeros((count, *press.grid.shape, 3), np.float32)
        self._traction = np.zeros((count, *press.grid.shape, 3), np.float32)
        self._quality = no_quality(count)
        self._start: tuple[float, float] | None = None
        self._work_most = 0.0

    def keep(self, frame: int) -> None:
        """Store the current state of the press as frame `frame`."""
        press, quality = self._press, self._quality
        self._surface[frame] = np.moveaxis(press.displacement, 0, -1)
        self._traction[frame] = np.moveaxis(press.traction, 0, -1)
        self._wrench[frame] = press.wrench
        overlap = max(0.0, -float(press.gap.min()))
        quality["overlap"][frame] = overlap
        touched = np.asarray(press.traction.any(axis=0))
        quality["contact_width"][frame] = width_of(
            touched, press.grid.x.astype(float), press.grid.y.astype(float)
        )
        quality["residual"][frame] = press.residual
        quality["contact"][frame] = overlap / -press.tip[2] if press.tip[2] < 0 else 0.0
        quality["energy_gap"][frame] = self._lost()
        quality["slip_excess"][frame] = press.slip_excess
        quality["newton"][frame] = press.spent.iterations
        quality["steps"][frame] = press.spent.steps
        press.spent = MoveCost()

    def _lost(self) -> float:
        energy, work = self._press.energy, self._press.work
        if self._start is None:
            self._start = energy, work
        stored, done = energy - self._start[0], work - self._start[1]
        self._work_most = max(self._work_most, done)
        return (done - stored) / self._work_most if self._work_most > 0 else 0.0

    def result(self, record: dict[str, Any]) -> Result:
        """Return the result; every frame must have been kept."""
        grid = self._press.grid
        return Result(
            scene=self._scene,
            tier="layer",
            wrench=self._wrench,
            surface_x=grid.x.astype(np.float64),
            surface_y=grid.y.astype(np.float64),
            surface=self._surface,
            traction=self._traction,
            quality=Quality(**self._quality),
            record=record,
        )


def simulate_layer(
    scene: Scene, layer: Layer = Layer(), *, progress: Progress | None = None
) -> Result:
    """Simulate one scene with small strains on an infinite layer, without sides or a surrounding.

    The scene has friction, and viscosity that relaxes all, but no mass.
    """
    check_supported(scene, layer.tolerance)
    began = time.perf_counter()
    press = LayerPress(scene, PixelGrid(scene.body, layer.grid), layer.tolerance)
    frames = LayerFrames(scene, press)
    ready = time.perf_counter()
    moving = 0.0
    before = 0.0
    for frame, (tip, now) in enumerate(zip(scene.motion.tip, scene.motion.time, strict=True)):
        start = time.perf_counter()
        press.move(np.array(tip), now - before)
        moving += time.perf_counter() - start
        before = now
        frames.keep(frame)
        if progress is not None:
            progress((frame + 1) / len(scene.motion))
    whole = time.perf_counter() - ready
    return frames.result(
        {
            "tier": "layer",
            "mesh": {"grid": list(press.grid.shape), "period": list(press.grid.period)},
            "precision": np.dtype(precision(layer.tolerance)).name,
            "device": "cpu",
            "tolerance": layer.tolerance,
            "effects": list(scene.effects.key),
            "seconds": {
                "build": round(ready - began, 4),
                "contact": round(moving, 4),
                "frames": round(whole - moving, 4),
            },
        }
    )


def check_supported(scene: Scene, tolerance: float) -> None:
    """Reject scenes that this tier does not support."""
    effects = scene.effects
    for name in ("inertia", "gravity"):
        if getattr(effects, name) is not None:
            raise SceneError(
                f"effects.{name}: {getattr(effects, name)!r}; allowed with tier 'layer': None (it "
                "has no mass; 'fem' has)"
            )
    if effects.viscosity is not None and effects.viscosity.relaxes != "all":
        raise SceneError(
            f"viscosity.relaxes: {effects.viscosity.relaxes!r}; allowed with tier 'layer': 'all' "
            "('fem' has both)"
        )
    if not 1e-10 <= tolerance <= 0.1:
        raise SceneError(f"tolerance: {tolerance!r}; allowed: 1e-10 to 0.1")
