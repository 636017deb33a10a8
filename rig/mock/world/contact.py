"""Frame of the contact, and the base of every World."""

from typing import Protocol

import numpy as np

from rig.core.geometry import matrix_from_vector
from rig.core.samples import WORLD_STATE
from trajectories import dome_height


class World(Protocol):
    """Computes the sensors' state from the arm's pose."""

    def step(self, t_ns: int, pose: np.ndarray) -> np.void:
        """Return the WORLD_STATE for TCP `pose` (6,) [m, rad] in the base frame at `t_ns`.

        Contact depends on its history, so times must not decrease.
        """


class ContactFrame:
    """Converts poses in the base frame to tips in the contact frame, whose pose is (6,) [m, rad].

    Without `dome_radius` [m] the top is flat; the F/T sensor's origin is `gauge_depth` below [m].
    """

    def __init__(
        self, pose: tuple[float, ...], dome_radius: float | None = None, gauge_depth: float = 0.0
    ) -> None:
        self._dome_radius, self._gauge_depth = dome_radius, gauge_depth
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

    def state(
        self, t_ns: int, pose: np.ndarray, tip: np.ndarray, shear: np.ndarray, wrench: np.ndarray
    ) -> np.void:
        """Return the WORLD_STATE of a contact, with the TCP `pose` (6,) in the base frame [m, rad].

        The tip (3,) is as `tip` returns it [m], the shear (2,) its mean displacement sideways [m],
        the wrench (6,) on the sensor about the tip [N, N m].
        """
        state: np.void = np.zeros(1, WORLD_STATE)[0]
        state["t_ns"] = t_ns
        state["pose"] = pose
        state["depth"] = -tip[2]
        state["contact"] = tip[:2]
        state["shear"] = shear
        state["wrench"] = wrench
        x, y, z = tip[0], tip[1], tip[2] + self._gauge_depth + self.top(tip)
        fx, fy, fz = wrench[:3]
        state["wrench"][3:] += (y * fz - z * fy, z * fx - x * fz, x * fy - y * fx)
        return state


def tip_of(state: np.void) -> np.ndarray:
    """Return the tip (3,) [m] of a WORLD_STATE, z above the top."""
    return np.array([*state["contact"], -state["depth"]])
