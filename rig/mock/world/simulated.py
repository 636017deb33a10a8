"""SimulatedWorld: the mock bench's sensors measure the result of the contact simulation.

A separate process (`rig.mock.world.press_solver`) solves the contact along the arm's path as often
as it can and publishes the solutions. The World extrapolates the last solution along its stiffness
to each of the arm's cycles. Cameras draw the markers at their deformed positions.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rig.bench.indenter import find_indenter
from rig.bench.worlds import SimulatedSpec
from rig.core.clock import SECOND_NS
from rig.core.errors import ConfigError
from rig.core.geometry import matrix_from_vector
from rig.core.mock_names import PRESS_FILE, SURFACE_FILE
from rig.core.samples import PRESS_STATE, WORLD_STATE, surface_state
from rig.core.shared_memory import AwaitedRecord, SharedLatest
from rig.mock.world.picture import MarkerPicture
from trajectories import dome_height

if TYPE_CHECKING:
    from sim.stream import LiveMarkers as LiveMarkers
    from sim.stream import LiveSensor as LiveSensor

# Limit of extrapolating images, relative to the distance of the last two deformations.
_AHEAD = 1.5
# Tips closer to each other than this [m] define no direction of extrapolation.
_MOVED = 2e-6


class SimulatedWorld:
    """Extrapolates the solver's last solution to each cycle of the arm."""

    def __init__(self, spec: SimulatedSpec, contact_frame: tuple[float, ...], folder: Path) -> None:
        self._spec = spec
        self._frame = ContactFrame(contact_frame, spec.dome_radius)
        self._presses = SharedLatest.attach(folder / PRESS_FILE, PRESS_STATE)
        self._count = 0
        self._between = Between(round(SECOND_NS / spec.rate_hz))

    def step(self, t_ns: int, pose: np.ndarray) -> np.void:
        """Return the next state.

        Args:
            t_ns: Time of the pose [ns].
            pose: TCP in the base frame (6,) [m, rad].
        """
        tip = self._frame.tip(pose)
        if (count := self._presses.count) != self._count:
            newest = self._presses.read()
            if newest is not None:
                self._count = count
                self._between.take(newest, t_ns, tip)
        values = self._between.at(t_ns, tip)
        state: np.void = np.zeros(1, WORLD_STATE)[0]
        state["t_ns"] = t_ns
        state["pose"] = pose
        state["depth"] = -tip[2]
        state["contact"] = tip[:2]
        state["shear"] = self._between.press["shear"]
        state["wrench"] = values[:6]
        lever = tip + np.array([0.0, 0.0, self._spec.gauge_depth + self._frame.top(tip)])
        state["wrench"][3:] += np.cross(lever, values[:3])
        state["taxels"] = np.clip(values[6:], 0, 65535).reshape(16, 3)
        return state


class ContactFrame:
    """Converts poses in the base frame to tips in the contact frame.

    Args:
        pose: Pose of the contact frame in the base frame (6,) [m, rad].
        dome_radius: Radius of the sensor's spherical top [m]; None: flat.
    """

    def __init__(self, pose: tuple[float, ...], dome_radius: float | None = None) -> None:
        self._dome_radius = dome_radius
        self._origin = np.array(pose[:3])
        self._rotation = matrix_from_vector(np.array(pose[3:]))

    def tip(self, pose: np.ndarray) -> np.ndarray:
        """Return the tip (3,) [m] of the TCP at `pose` (6,) [m, rad], z above the top there."""
        tip: np.ndarray = self._rotation.T @ (np.asarray(pose[:3]) - self._origin)
        tip[2] -= self.top(tip)
        return tip

    def top(self, tip: np.ndarray) -> float:
        """Return the height of the sensor's undeformed top at a tip's place [m]."""
        return dome_height(self._dome_radius, float(tip[0]), float(tip[1]))


class Between:
    """Wrench about the tip and taxels (54,), continuous from one solution to the next.

    The difference of a new solution from its prediction is faded in over the time of one solution.
    A gel's force never jumps, and a predictive guard would stop for a jump.

    Args:
        fade_ns: Duration of the fade, the time of one solution.
    """

    def __init__(self, fade_ns: int) -> None:
        self.press: np.void = np.zeros(1, PRESS_STATE)[0]
        """PRESS_STATE that is extrapolated."""
        self._fade_ns = fade_ns
        self._offset: np.ndarray = np.zeros_like(self.press["values"])
        self._since_ns = 0

    def take(self, press: np.void, t_ns: int, tip: np.ndarray) -> None:
        """Extrapolate this PRESS_STATE from now on; it arrived at `t_ns` with tip (3,) [m]."""
        first = self.press["t_ns"] == 0
        before = self._blended(t_ns, tip)
        self.press = press
        now = extrapolated(press, t_ns, tip)
        self._offset, self._since_ns = (0 * now if first else before - now), t_ns

    def at(self, t_ns: int, tip: np.ndarray) -> np.ndarray:
        """Return the values for a tip (3,) [m] at `t_ns`.

        The contact never pulls, nor does its drag exceed friction.
        """
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
    """Return wrench about the tip and taxels (54,) for a tip (3,) [m] at `t_ns`.

    They are extrapolated along the PRESS_STATE's slope from its tip; without contact, from the
    undeformed surface.
    """
    values: np.ndarray = press["values"].copy()
    if press["touching"]:
        values += press["slope"] @ (tip - press["tip"])
        values += press["rate"] * (1e-9 * (t_ns - press["t_ns"]))
    else:
        values += press["slope"][:, 2] * min(tip[2], 0.0)
    return values


class SimulatedView:
    """Draws the simulated sensor's markers for a WORLD_STATE."""

    def __init__(self, spec: SimulatedSpec, folder: Path) -> None:
        self._markers, self._shape = markers_of(spec)
        self._solved = AwaitedRecord(folder / SURFACE_FILE, surface_state(self._shape))
        self._picture = MarkerPicture(
            background=spec.background,
            ink=spec.ink,
            grey_noise=0.0 if spec.noise is None else spec.noise.grey,
        )

    def __call__(self, state: np.void) -> np.ndarray:
        """Return the image: RGB (480, 640, 3) uint8."""
        surface = self.surface(np.array([*state["contact"], -state["depth"]]))
        return self._picture.image(self._markers.outlines(surface))

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


def live_sensor(spec: SimulatedSpec, indenter: str) -> LiveSensor:
    """Return the simulated sensor under the indenter of that name."""
    try:
        from sim.indenters import from_stl, named
        from sim.stream import LiveSensor

        row, solid = _row(spec), find_indenter(indenter).stl
        # No press is deeper than the skin is thick.
        reach = row.body.thickness
        body = named(indenter) if solid is None else from_stl(solid, name=indenter, reach=reach)
        return LiveSensor(row, body, grid=spec.grid)
    except ImportError as error:
        raise _missing(error) from None
    except ValueError as error:
        raise ConfigError(f"world: {error}") from None


def note_on(spec: SimulatedSpec) -> str:
    """Return a note on a twin whose fit was by another tier than the one that presses it here."""
    posterior = _row(spec).posterior
    if posterior is None or posterior.tier == "layer":
        return ""
    return f"; its skin was fitted by tier {posterior.tier}, and tier layer gives it other forces"


def markers_of(spec: SimulatedSpec) -> tuple[LiveMarkers, tuple[int, int]]:
    """Return the simulated sensor's markers, and the shape (X, Y) of its deformation's points."""
    try:
        from sim.layer.spectral import PixelGrid
        from sim.stream import LiveMarkers

        row = _row(spec)
        grid = PixelGrid(row.body, spec.grid)
        return LiveMarkers(row, grid), grid.shape
    except ImportError as error:
        raise _missing(error) from None
    except ValueError as error:
        raise ConfigError(f"world: {error}") from None


def _row(spec: SimulatedSpec) -> Any:
    from sim.sensors import sensor_of

    return sensor_of(spec.sensor)


def _missing(error: ImportError) -> ConfigError:
    return ConfigError(
        f"world.kind: 'simulated', but {error}; allowed: with the simulator, pip install "
        "'tactile-rig[sim]'"
    )
