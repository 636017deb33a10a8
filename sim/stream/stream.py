"""A live sensor: a press and what is measured of it, with what it takes to answer in between."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError
from sim.indenters import Indenter
from sim.layer import Grid, Press
from sim.layer.contact import Clearance
from sim.layer.solver import History, check_known
from sim.scene import Motion, Scene
from sim.sensors import Pins, SimulatedSensor, SurfaceField, TaxelPad, TaxelSignal
from sim.sensors.field import EVEN_STEP, cubic_weights

# A layer whose indenter keeps to the material that it has dragged along.

Array = NDArray[np.floating[Any]]


class Carried(Clearance):
    """The gap to an indenter above material that has moved aside by `drag` (2,) [m]."""

    def __init__(self, indenter: Indenter, grid: Grid, motion: Motion) -> None:
        super().__init__(indenter, grid, motion)
        self.drag: Array = np.zeros(2)

    def at(self, tip: Array) -> Array:
        """The gap at every pixel (nx, ny) with the tip at (3,) [m]."""
        return super().at(tip - np.array([*self.drag, 0.0]))


class CarriedPress(Press):
    """The `layer` tier's press with the sideways displacement of what is touched in its gaps.

    Small strains let the gap be taken above untouched material, so an indenter that drags its
    contact along leaves the pixels it sticks to, one row after the other, and its force jumps with
    each. Here the gap is taken above material displaced as what was touched last is on average: as
    long as it sticks, the pixels that it presses stay the same ones.
    """

    def __init__(self, scene: Scene, grid: Grid, tolerance: float) -> None:
        super().__init__(scene, grid, tolerance)
        self._carried = Carried(scene.indenter, grid, scene.motion)
        self._clearance = self._carried

    @property
    def shear(self) -> Array:
        """Mean sideways displacement of what is touched (2,) [m]; 0 where nothing is."""
        touched = self.traction[2] != 0
        if not touched.any():
            return np.zeros(2)
        moved: Array = self.displacement[:2, touched].mean(axis=1)
        return moved

    def move(self, tip: Array, duration: float) -> None:
        """Bring the tip straight to `tip` (3,) [m] in `duration` [s], as `Press.move`."""
        super().move(tip, duration)
        limit = self.grid.body.thickness
        self._carried.drag = np.clip(self.shear, -limit, limit)


# A layer under an indenter whose tip goes where it is told, from pose to pose.

# Pixels along the longer side: fewer than a `simulate` has, for half of its time.
GRID = 96
# Residual of the contact: moves forces by some 1e-3, five times what a `simulate` allows.
TOLERANCE = 1e-2
# How far it goes on pressing, in depths that the sensor is meant for: an arm may overshoot.
DEEPER = 2.0
# A dent that is left of a press counts as gone when it is shallower than this [m].
RECOVERED = 0.1e-6


class LivePress:
    """The `layer` tier, pose by pose. Poses that it cannot reach are taken to its nearest ones.

    Args:
        sensor: What is pressed.
        indenter: With what.
        grid: Pixels along the body's longer side, 16 to 512.
        tolerance: Residual of the contact (`Contact.residual`), 1e-10 to 0.1.

    Raises:
        SceneError: A sensor or an effect that the tier does not know.
    """

    def __init__(
        self,
        sensor: SimulatedSensor,
        indenter: Indenter,
        *,
        grid: int = GRID,
        tolerance: float = TOLERANCE,
    ) -> None:
        body = sensor.body
        self._deepest = min(DEEPER * sensor.depth_max, 0.9 * body.thickness)
        self._thickness = body.thickness
        self._far = _beyond_reach(indenter, body.size_x, body.size_y)
        still = sensor.scene(indenter, Motion(tip=((0.0, 0.0, 0.0),), time=(0.0,)))
        self.scene = Scene(still.indenter, self._anywhere(), body=body, effects=still.effects)
        """The sensor and the indenter, in a motion that goes everywhere."""
        check_known(self.scene, tolerance)
        self._press = CarriedPress(self.scene, Grid(body, grid), tolerance)
        self._rests = True

    @property
    def grid(self) -> Grid:
        """The pixels of the top."""
        return self._press.grid

    @property
    def field(self) -> SurfaceField:
        """The displaced top, as a sensor reads it."""
        x, y = (np.asarray(axis, np.float64) for axis in (self.grid.x, self.grid.y))
        return SurfaceField(x, y, self.displacement[None])

    @property
    def tip(self) -> Array:
        """Where the tip is taken to be (3,) [m]."""
        return self._press.tip

    @property
    def touching(self) -> bool:
        """Whether anything is pressed."""
        return bool(self._press.traction[2].any())

    @property
    def wrench(self) -> Array:
        """Force and torque about the tip of the indenter on the body (6,) [N, N m]."""
        return self._press.wrench

    @property
    def shear(self) -> Array:
        """Mean sideways displacement of what is touched (2,) [m]; 0 where nothing is."""
        return self._press.shear

    @property
    def displacement(self) -> NDArray[np.float32]:
        """Of the top (X, Y, 3) [m]."""
        moved: NDArray[np.float32] = np.ascontiguousarray(
            np.moveaxis(self._press.displacement, 0, -1), np.float32
        )
        return moved

    def relaxing(self, within: float) -> Array:
        """Mean rate of the force (3,) [N/s] over the next `within` [s] if the tip stays there."""
        history = self._press.history
        after = history.after(within)
        traction = after.factor * history.elastic + after.held
        change: Array = (traction - self._press.traction).sum(axis=(1, 2))
        return change * (self.grid.area / within)

    def move(self, tip: Array, duration: float) -> None:
        """Bring the tip straight to `tip` (3,) [m] in `duration` [s].

        Raises:
            SceneError: A pose that is not finite, or a time below 0.
            SimulationDiverged: No contact was found; the press is as it was some steps before.
        """
        tip = np.asarray(tip, float)
        if tip.shape != (3,) or not np.isfinite(tip).all():
            raise SceneError(f"tip: {tip!r}; allowed: 3 finite numbers [m]")
        if not (np.isfinite(duration) and duration >= 0):
            raise SceneError(f"duration: {duration!r} s; allowed: 0 or more")
        tip = self._nearest(tip)
        if self._rests and tip[2] >= 0:
            self._press.tip = tip
            return
        self._press.move(tip, duration)
        self._rests = not self.touching and self._recovered()

    def _recovered(self) -> bool:
        """Whether there is no dent any more; what is less than one is forgotten."""
        press = self._press
        if np.abs(press.displacement).max() > RECOVERED:
            return False
        press.history = History(self.scene.effects.viscosity, self.grid.shape)
        press.displacement = np.zeros_like(press.displacement)
        return True

    def _nearest(self, tip: Array) -> Array:
        x, y = self._far
        near = np.clip(tip, [-x, -y, -self._deepest], [x, y, np.inf])
        if abs(tip[0]) >= x or abs(tip[1]) >= y:
            # Beside the body; as deep as ever there is nothing to touch.
            near[2] = max(near[2], 0.0)
        return near

    def _anywhere(self) -> Motion:
        # What is dragged along is looked for where it came from: a thickness away at most.
        (x, y), low = (far + self._thickness for far in self._far), -self._deepest
        corners = ((0.0, 0.0, 0.0), (x, y, low), (-x, -y, low))
        return Motion(tip=corners, time=(0.0, 1.0, 2.0))


def _beyond_reach(indenter: Indenter, size_x: float, size_y: float) -> tuple[float, float]:
    """How far aside of the body's middle the tip touches nothing, or a body's width [m]."""
    widths = [max(abs(side[0]), abs(side[1])) for side in indenter.bounds[:2]]
    x, y = (
        size / 2 + min(width, size) for size, width in zip((size_x, size_y), widths, strict=True)
    )
    return x, y


# What a sensor's values do when the tip goes on, learned from the moves that it made.

# A move this long is believed by half [m]: the shorter it is, the more of what it changed is the
# tolerance of the solutions and the grain of the grid.
SURE = 20e-6


class Slope:
    """d values / d tip (n, 3), corrected along each move and kept across it.

    Broyden's update (Math. Comp. 19 (1965) 577), damped: of all matrices that give what the last
    move gave, the one nearest to that before; short moves are believed less. A contact that is
    pressed and then sheared keeps its stiffness to pressing while it learns that to shear, and a
    move back finds the stiffness of the way there.

    Args:
        count: Of the values.
    """

    def __init__(self, count: int) -> None:
        self.matrix: Array = np.zeros((count, 3))
        """(n, 3), in units of the values a metre."""

    def learn(self, moved: Array, changed: Array) -> None:
        """A move of the tip by `moved` (3,) [m] changed the values by `changed` (n,)."""
        missed = changed - self.matrix @ moved
        share = moved / (float(moved @ moved) + SURE**2)
        self.matrix = self.matrix + np.outer(missed, share)


# Time over which relaxation is foretold [s]: about that from one solution to the next.
WITHIN = 20e-3
# Tips of a press that tries the sensor out, in depths that it is meant for.
LIGHT = ((0.0, 0.0, -0.05), (0.025, 0.0, -0.05), (0.025, 0.025, -0.05))
# Counts of a pad: 16 taxels, 3 axes.
COUNTS = 48


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """The last solution, and how to go on from it while the next one is made.

    Values are the wrench about the tip (6,) [N, N m], then the raw counts (48,) of a pad of taxels,
    0 without one. For a tip near `tip`, `seconds` later:

        values + slope (x - tip) + rate seconds    where `touching`
        values + slope (0, 0, min(z, 0))           where it did not touch yet
    """

    tip: Array
    """(3,) [m]."""
    touching: bool
    values: Array
    """(54,)."""
    slope: Array
    """(54, 3) [1/m]; of the contact before, as long as nothing is touched."""
    rate: Array
    """(54,) [1/s]: what relaxes while the tip stays."""


class LiveSensor:
    """A sensor that is told where the indenter's tip is.

    Arguments and errors as `LivePress`.
    """

    def __init__(
        self,
        sensor: SimulatedSensor,
        indenter: Indenter,
        *,
        grid: int = GRID,
        tolerance: float = TOLERANCE,
    ) -> None:
        signal = sensor.signal
        self._pad = TaxelPad(sensor.body, signal) if isinstance(signal, TaxelSignal) else None
        self._slope = Slope(6 + COUNTS)
        # The first contact is foretold from a light one that is then forgotten.
        self.press = LivePress(sensor, indenter, grid=grid, tolerance=tolerance)
        self.answer = self._untouched()
        """The newest."""
        for x, y, z in LIGHT:
            self.move(sensor.depth_max * np.array([x, y, z]), 0.0)
        self.press = LivePress(sensor, indenter, grid=grid, tolerance=tolerance)
        self.answer = self._untouched()

    def move(self, tip: Array, duration: float) -> None:
        """Bring the tip to `tip` (3,) [m] in `duration` [s]; errors as `LivePress.move`."""
        before, press = self.answer, self.press
        press.move(tip, duration)
        values, rate = self._values(), np.zeros(6 + COUNTS)
        if press.touching:
            way = press.tip - (before.tip if before.touching else _touched(before.tip, press.tip))
            self._slope.learn(way, values - before.values - duration * before.rate)
            rate[:3] = press.relaxing(WITHIN)
        self.answer = Answer(press.tip, press.touching, values, self._slope.matrix, rate)

    def _untouched(self) -> Answer:
        return Answer(
            self.press.tip,
            touching=False,
            values=self._values(),
            slope=self._slope.matrix,
            rate=np.zeros(6 + COUNTS),
        )

    def _values(self) -> Array:
        press, values = self.press, np.zeros(6 + COUNTS)
        values[:6] = press.wrench
        if self._pad is not None:
            values[6:] = self._pad.raw(press.field)[0].ravel()
        return values


def _touched(before: Array, now: Array) -> Array:
    """Where on the way the tip went through the untouched surface (3,) [m]."""
    if before[2] <= 0 or now[2] >= 0:
        return before
    place: Array = before + (now - before) * (before[2] / (before[2] - now[2]))
    return place


# Tips of pins, quickly: what `Pins.tips` finds on a fine grid of the skin, at the pins alone.

FloatArray = NDArray[np.float64]

# Places along an axis whose weighted mean is a Gaussian's, in its standard deviations: exact for
# polynomials up to the fifth degree (Gauss and Hermite's rule of three).
NODES = (-math.sqrt(3.0), 0.0, math.sqrt(3.0))
SHARES = np.array([1.0, 4.0, 1.0]) / 6.0


class LiveTips:
    """Displacement of the tips of some pins, from that of the skin.

    Args:
        pins: The pins.
        x: Of the points of the skin (X,) [m], rising.
        y: The same (Y,).
        centres: Where the pins are (n, 2) [m].
    """

    def __init__(self, pins: Pins, x: FloatArray, y: FloatArray, centres: FloatArray) -> None:
        self._length = pins.length
        self._x, self._slope_x = _weights(x, centres[:, 0], pins.base)
        self._y, self._slope_y = _weights(y, centres[:, 1], pins.base)

    def displacement(self, skin: NDArray[np.float32]) -> FloatArray:
        """Of the tips (n, 3) [m]; `skin` is the displacement (X, Y, 3) [m]."""
        rows, columns, _ = skin.shape
        flat = skin.reshape(rows, columns * 3).astype(float)
        pins, nodes = len(self._x) // len(NODES), len(NODES)

        def at(along_x: FloatArray, along_y: FloatArray) -> FloatArray:
            """Values at each pin's nodes (n, nodes, nodes, 3)."""
            lines = (along_x @ flat).reshape(pins, nodes, columns, 3)
            crossed = np.matmul(along_y.reshape(pins, 1, nodes, columns), lines)
            return np.asarray(crossed)

        tangent_x = at(self._slope_x, self._y) + np.array([1.0, 0.0, 0.0])
        tangent_y = at(self._x, self._slope_y) + np.array([0.0, 1.0, 0.0])
        normal = np.cross(tangent_x, tangent_y)
        normal = _averaged(normal / np.linalg.norm(normal, axis=-1, keepdims=True))
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        moved = _averaged(at(self._x, self._y))
        tips: FloatArray = moved + self._length * (np.array([0.0, 0.0, 1.0]) - normal)
        return tips


def _averaged(values: FloatArray) -> FloatArray:
    """Means (n, 3) over the feet of values at their nodes (n, nodes, nodes, 3)."""
    mean: FloatArray = np.einsum("nabc,a,b->nc", values, SHARES, SHARES)
    return mean


def _weights(known: FloatArray, centres: FloatArray, base: float) -> tuple[FloatArray, FloatArray]:
    """Weights (n * nodes, K) of values at `known` (K,) in the value at each node, and its slope."""
    count = max(2, round((known[-1] - known[0]) / EVEN_STEP) + 1)
    even = np.linspace(known[0], known[-1], count)
    fine = cubic_weights(known, even)
    # The spread of a disc along an axis is a quarter of its width.
    nodes = (centres[:, None] + base / 4 * np.array(NODES)).ravel()
    to_nodes = cubic_weights(even, nodes)
    return to_nodes @ fine, to_nodes @ np.gradient(fine, even[1] - even[0], axis=0)
