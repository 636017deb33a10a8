"""Live sensor: a press, its readings, and their extrapolation between solutions."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.errors import SceneError
from sim.indenters import Indenter
from sim.layer.contact import Clearance
from sim.layer.solver import History, LayerPress, check_supported
from sim.layer.spectral import PixelGrid
from sim.scene import Motion, Scene
from sim.sensors import SimulatedSensor, SurfaceField, TaxelPad, TaxelSignal

# A layer whose contact follows the material that the indenter drags along.

Array = NDArray[np.floating[Any]]


# Least cosine between sideways moves that follow one line.
STRAIGHT = 0.9


class DraggedClearance(Clearance):
    """Gap to an indenter above material that has moved sideways by `drag` (2,) [m]."""

    def __init__(self, indenter: Indenter, grid: PixelGrid, motion: Motion) -> None:
        super().__init__(indenter, grid, motion)
        self.drag: Array = np.zeros(2)
        self.start: Array = np.zeros(2)
        """Where the tip had moved the material by `drag` (2,) [m]."""
        self.follows = 0.0
        """Fraction of the tip's way from there by which the material moves on."""

    def at(self, tip: Array) -> tuple[Array, Array]:
        """Return gaps and how much more pixels yield, as `Clearance.at`, tip at (3,) [m]."""
        drag = self.drag + self.follows * (tip[:2] - self.start)
        return super().at(tip - np.array([*drag, 0.0]))


# Pixels along the longer side: fewer than in `simulate`, for half of its time.
GRID = 96
# Residual of the contact: changes forces by about 1e-3, five times as much as in `simulate`.
TOLERANCE = 1e-2
# Limit of the depth, as a multiple of the sensor's `depth_max`: an arm may overshoot.
DEEPER = 2.0
# A dent that remains after a press counts as recovered when it is shallower than this [m].
RECOVERED = 0.1e-6


class LivePress(LayerPress):
    """Press of tier `layer`, pose by pose; poses out of reach are moved to the nearest valid ones.

    With small strains, the gap is measured above undeformed material. An indenter that drags its
    contact along then leaves the pixels it sticks to, row by row, and its force jumps at each row.
    Here the gap is measured above material displaced by the mean of the last contact, so that a
    sticking indenter keeps pressing the same pixels.

    Args:
        sensor: Sensor to press.
        indenter: Indenter to press with.
        grid: Pixels along the body's longer side, 16 to 512.
        tolerance: Residual of the contact (`Contact.residual`), 1e-10 to 0.1.

    Raises:
        SceneError: The tier does not support the sensor or an effect.
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
        # The gap is also evaluated where dragged material came from, at most a thickness away.
        (x, y), low = (far + self._thickness for far in self._far), -self._deepest
        anywhere = Motion(((0.0, 0.0, 0.0), (x, y, low), (-x, -y, low)), time=(0.0, 1.0, 2.0))
        self.scene = Scene(still.indenter, anywhere, body=body, effects=still.effects)
        """Sensor and indenter, with a motion that spans all poses."""
        check_supported(self.scene, tolerance)
        super().__init__(self.scene, PixelGrid(body, grid), tolerance)
        self._dragged = DraggedClearance(self.scene.indenter, self.grid, self.scene.motion)
        self._clearance = self._dragged
        self._way: Array = np.zeros(2)
        self._rests = True

    @property
    def field(self) -> SurfaceField:
        """Displacement of the top, for the sensor's readout."""
        x, y = (np.asarray(axis, np.float64) for axis in (self.grid.x, self.grid.y))
        moved = np.ascontiguousarray(np.moveaxis(self.displacement, 0, -1), np.float32)
        return SurfaceField(x, y, moved[None])

    @property
    def touching(self) -> bool:
        """True if the indenter is in contact."""
        return bool(self.traction[2].any())

    @property
    def relaxed_force(self) -> Array:
        """Force that would remain if the body relaxed at its present displacement (3,) [N]."""
        return np.asarray(self.history.elastic.sum(axis=(1, 2)) * self.grid.area)

    @property
    def shear(self) -> Array:
        """Mean sideways displacement of the contact (2,) [m]; 0 without contact."""
        touched = self.traction[2] != 0
        if not touched.any():
            return np.zeros(2)
        return np.asarray(self.displacement[:2, touched].mean(axis=1))

    def relaxing(self, within: float) -> Array:
        """Return the force's mean rate (3,) [N/s] over the next `within` [s] at a fixed tip."""
        after = self.history.after(within)
        traction = after.factor * self.history.elastic + after.held
        change: Array = (traction - self.traction).sum(axis=(1, 2))
        return change * (self.grid.area / within)

    def move(self, tip: Array, duration: float) -> None:
        """Move the tip straight to `tip` (3,) [m] in `duration` [s].

        Raises:
            SceneError: The pose is not finite, or the duration is below 0.
            SimulationDiverged: No contact was found; the press is in the state of some steps ago.
        """
        tip = np.asarray(tip, float)
        if tip.shape != (3,) or not np.isfinite(tip).all():
            raise SceneError(f"tip: {tip!r}; allowed: 3 finite numbers [m]")
        if not (np.isfinite(duration) and duration >= 0):
            raise SceneError(f"duration: {duration!r} s; allowed: 0 or more")
        tip = self._nearest(tip)
        if self._rests and tip[2] >= 0:
            self.tip = tip
            return
        self._drag(tip, duration)
        self._rests = not self.touching and self._recovered()

    def _drag(self, tip: Array, duration: float) -> None:
        """Move the tip, and the material that the gap is measured above along with it."""
        start, before, dragged = self.tip[:2], self.shear, self._dragged
        way = tip[:2] - start
        length = float(np.linalg.norm(way))
        dragged.start = start
        if length > 0:
            # Contacts stick after a turn, and go on as they did along a straight way.
            straight = float(way @ self._way) > STRAIGHT * length * float(np.linalg.norm(self._way))
            dragged.follows = dragged.follows if straight else 1.0
            self._way = way
        if not self.touching:
            dragged.follows = 0.0
        super().move(tip, duration)
        dragged.drag = np.clip(self.shear, -self._thickness, self._thickness)
        dragged.start = tip[:2]
        if length > 0:
            follows = float((self.shear - before) @ way) / length**2
            dragged.follows = float(np.clip(follows, 0.0, 1.0))

    def _recovered(self) -> bool:
        """Return True if the dent has recovered, and reset the remaining displacement."""
        if np.abs(self.displacement).max() > RECOVERED:
            return False
        self.history = History(self.scene.effects.viscosity, self.grid.shape)
        self.displacement = np.zeros_like(self.displacement)
        return True

    def _nearest(self, tip: Array) -> Array:
        x, y = self._far
        near = np.clip(tip, [-x, -y, -self._deepest], [x, y, np.inf])
        if abs(tip[0]) >= x or abs(tip[1]) >= y:
            # Beside the body there is nothing to touch at any depth.
            near[2] = max(near[2], 0.0)
        return near


def _beyond_reach(indenter: Indenter, size_x: float, size_y: float) -> tuple[float, float]:
    """Return the distances along x and y [m] from the middle beyond which a tip touches nothing.

    The indenter's width counts up to the width of the body.
    """
    widths = [max(abs(side[0]), abs(side[1])) for side in indenter.bounds[:2]]
    x, y = (
        size / 2 + min(width, size) for size, width in zip((size_x, size_y), widths, strict=True)
    )
    return x, y


# Derivative of a sensor's values by the tip's position, learned from past moves.

# Length of a move that gets half the weight [m]: in the changes of shorter moves, the tolerance of
# the solutions and the grid's resolution weigh more.
SURE = 20e-6


class Slope:
    """Jacobian d values / d tip (n, 3), updated along each move and kept across it.

    This is Broyden's update (Math. Comp. 19 (1965) 577), damped: of all matrices that reproduce the
    last move, the one nearest to the previous matrix, with less weight on short moves. A contact
    that is pressed and then sheared keeps its normal stiffness while the shear stiffness is
    learned, and a move back starts from the stiffness of the way there.
    """

    def __init__(self, count: int) -> None:
        self.matrix: Array = np.zeros((count, 3))
        """Jacobian (n, 3), in units of the values per metre."""

    def learn(self, moved: Array, changed: Array) -> None:
        """Update after a move by `moved` (3,) [m] that changed the values by `changed` (n,)."""
        missed = changed - self.matrix @ moved
        fraction = moved / (float(moved @ moved) + SURE**2)
        self.matrix = self.matrix + np.outer(missed, fraction)


# Time over which relaxation is extrapolated [s]: about the interval between solutions.
WITHIN = 20e-3
# Tips of a light press that initialises the slope, in multiples of the sensor's `depth_max`.
LIGHT = ((0.0, 0.0, -0.05), (0.025, 0.0, -0.05), (0.025, 0.025, -0.05))


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Latest solution, and its extrapolation until the next one is ready.

    Values are the wrench about the tip (6,) [N, N m], then the raw counts of a pad of taxels, by
    taxel and axis, none without one. For a tip near `tip`, `seconds` later:

        values + slope (x - tip) + rate seconds    if `touching`
        values + slope (0, 0, min(z, 0))           if not touching yet
    """

    tip: Array
    """Position of the tip (3,) [m]."""
    touching: bool
    values: Array
    """Wrench and counts (v,)."""
    slope: Array
    """Derivative by the tip (v, 3) [1/m]; without contact, that of the last contact."""
    rate: Array
    """Rate of relaxation at a fixed tip (v,) [1/s]."""


class LiveSensor:
    """Simulated sensor that follows the indenter's tip.

    Arguments and errors are those of `LivePress`.
    """

    def __init__(self, sensor: SimulatedSensor, indenter: Indenter, *, grid: int = GRID) -> None:
        signal = sensor.signal
        self._pad = TaxelPad(sensor.body, signal) if isinstance(signal, TaxelSignal) else None
        self._count = 6 + (0 if self._pad is None else 3 * len(self._pad.signal.places))
        self._slope = Slope(self._count)
        # A light press gives the slope of the first contact, and is then discarded.
        self.press = LivePress(sensor, indenter, grid=grid)
        self.answer = self._no_contact()
        """Latest solution."""
        for x, y, z in LIGHT:
            self.move(sensor.depth_max * np.array([x, y, z]), 0.0)
        self.press = LivePress(sensor, indenter, grid=grid)
        self.answer = self._no_contact()

    def move(self, tip: Array, duration: float) -> None:
        """Move the tip to `tip` (3,) [m] in `duration` [s]; errors as `LivePress.move`."""
        before, press = self.answer, self.press
        press.move(tip, duration)
        values, rate = self._values(), np.zeros(self._count)
        if press.touching:
            way = press.tip - (before.tip if before.touching else _touched(before.tip, press.tip))
            self._slope.learn(way, values - before.values - duration * before.rate)
            rate[:3] = press.relaxing(WITHIN)
        self.answer = Answer(press.tip, press.touching, values, self._slope.matrix, rate)

    def _no_contact(self) -> Answer:
        values, rate = self._values(), np.zeros(self._count)
        return Answer(self.press.tip, False, values, self._slope.matrix, rate)

    def _values(self) -> Array:
        press, values = self.press, np.zeros(self._count)
        values[:6] = press.wrench
        if self._pad is not None:
            values[6:] = self._pad.raw(press.field)[0].ravel()
        return values


def _touched(before: Array, now: Array) -> Array:
    """Return the point at which the tip crossed the undeformed surface (3,) [m]."""
    if before[2] <= 0 or now[2] >= 0:
        return before
    return np.asarray(before + (now - before) * (before[2] / (before[2] - now[2])))
