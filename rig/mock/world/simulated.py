"""SimulatedWorld: the mock bench's sensors measure the result of the contact simulation.

A separate process (`rig.mock.world.press_solver`) solves the contact along the arm's path as often
as it can and publishes the solutions. The World extrapolates the last solution along its stiffness
to each of the arm's cycles.
"""

import math
from pathlib import Path

import numpy as np

from rig.bench.worlds import WorldSpec
from rig.core.clock import SECOND_NS
from rig.core.mock_names import PRESS_FILE, SURFACE_FILE
from rig.core.samples import press_state, surface_state
from rig.core.shared_memory import AwaitedRecord
from rig.mock.world.contact import ContactFrame, tip_of
from rig.mock.world.sensors import dome_of, row_of, sampler_of, taxels_of

# Limit of extrapolating images, relative to the distance of the last two deformations.
_AHEAD = 1.5
# Tips closer to each other than this [m] define no direction of extrapolation.
_MOVED = 2e-6


def values_of(spec: WorldSpec) -> int:
    """Return the number of values of a solution: the wrench, and counts of taxels."""
    rows, columns = taxels_of(spec)
    return 6 + 3 * rows * columns


class SimulatedWorld:
    """Extrapolates the solver's last solution to each cycle of the arm."""

    def __init__(self, spec: WorldSpec, contact_frame: tuple[float, ...], folder: Path) -> None:
        dome = dome_of(row_of(spec), spec.tier)
        self._frame = ContactFrame(contact_frame, dome, spec.gauge_depth)
        self._between = Between(spec, folder)

    def step(self, t_ns: int, pose: np.ndarray) -> np.void:
        """Return the state at `t_ns` of the TCP at `pose` (6,) in the base frame [m, rad]."""
        tip = self._frame.tip(pose)
        values = self._between.at(t_ns, tip)
        return self._frame.state(t_ns, pose, tip, self._between.press["shear"], values[:6])


class Between:
    """Wrench about the tip and taxels (v,), continuous from one solution to the next.

    The difference of a new solution from its prediction is faded in over the time of one solution.
    A gel's force never jumps, and a predictive guard would stop for a jump.
    """

    def __init__(self, spec: WorldSpec, folder: Path) -> None:
        dtype = press_state(values_of(spec))
        self._presses = AwaitedRecord(folder / PRESS_FILE, dtype)
        self._count = 0
        self.press: np.void = np.zeros(1, dtype)[0]
        """Record of `press_state` that is extrapolated."""
        self._fade_ns = round(SECOND_NS / spec.solver.rate_hz)
        self._offset: np.ndarray = np.zeros_like(self.press["values"])
        self._since_ns = 0

    def take(self, press: np.void, t_ns: int, tip: np.ndarray) -> None:
        """Extrapolate this solution from now on; it arrived at `t_ns` with tip (3,) [m]."""
        first = self.press["t_ns"] == 0
        before = self._blended(t_ns, tip)
        self.press = press
        now = extrapolated(press, t_ns, tip)
        self._offset, self._since_ns = (0 * now if first else before - now), t_ns

    def at(self, t_ns: int, tip: np.ndarray) -> np.ndarray:
        """Return the values for a tip (3,) [m] at `t_ns`, by the solver's newest solution.

        The contact never pulls, nor does its drag exceed friction.
        """
        if (count := self._presses.count) != self._count:
            newest = self._presses.read()
            if newest is not None:
                self._count = count
                self.take(newest, t_ns, tip)
        values = self._blended(t_ns, tip)
        if tip[2] >= 0 or values[2] > 0:
            values[:6] = 0.0
        drag, most = math.hypot(*values[:2]), -float(self.press["friction"] * values[2])
        if drag > most:
            values[:2] *= most / drag
        return values

    def _blended(self, t_ns: int, tip: np.ndarray) -> np.ndarray:
        left = max(0.0, 1 - (t_ns - self._since_ns) / self._fade_ns)
        return extrapolated(self.press, t_ns, tip) + left * self._offset


def extrapolated(press: np.void, t_ns: int, tip: np.ndarray) -> np.ndarray:
    """Return wrench about the tip and taxels (v,) for a tip (3,) [m] at `t_ns`.

    They are extrapolated along the solution's slope from its tip; without contact, from the
    undeformed surface.
    """
    values: np.ndarray = press["values"].copy()
    if press["touching"]:
        values += press["slope"] @ (tip - press["tip"])
        values += press["rate"] * (1e-9 * (t_ns - press["t_ns"]))
    else:
        values += press["slope"][:, 2] * min(tip[2], 0.0)
    return values


class SimulatedSurface:
    """Displacement of a skin's points by the solver's last two solutions."""

    def __init__(self, spec: WorldSpec, folder: Path, points: np.ndarray) -> None:
        self._sampler, self._shape = sampler_of(spec, points)
        self._solved = AwaitedRecord(folder / SURFACE_FILE, surface_state(self._shape))

    def __call__(self, state: np.void) -> np.ndarray:
        """Return the displacement (n, 3) [m] of the points for a WORLD_STATE."""
        return np.asarray(self._sampler(self.surface(tip_of(state))))

    def surface(self, tip: np.ndarray) -> np.ndarray:
        """Return the deformation (X, Y, 3) float32 for a tip (3,) [m], from the last two."""
        newest = self._solved.read()
        if newest is None:
            return np.zeros((*self._shape, 3), np.float32)
        way = newest["tip"] - newest["tip_before"]
        surface: np.ndarray = newest["surface"]
        square = float(way @ way)
        if square < _MOVED**2:
            return surface
        fraction = float(np.clip((tip - newest["tip"]) @ way / square, -_AHEAD, _AHEAD))
        extrapolated: np.ndarray = surface + np.float32(fraction) * (
            surface - newest["surface_before"]
        )
        return extrapolated
