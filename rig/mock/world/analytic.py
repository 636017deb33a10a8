"""AnalyticWorld: closed-form signals of a mock bench's sensors for the arm's motion.

Friction, hysteresis and noise are absent unless the bench file sets them. Contact depends on its
history (the point of sticking, the relaxation), so one object processes the whole motion in order.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from rig.bench.worlds import AnalyticSpec
from rig.core.geometry import matrix_from_vector
from rig.core.samples import WORLD_STATE
from rig.mock.world.picture import PressedSurface
from trajectories import dome_height


class World(Protocol):
    """Computes the sensors' state from the arm's pose."""

    def step(self, t_ns: int, pose: np.ndarray) -> np.void:
        """Return the WORLD_STATE for TCP `pose` (6,) [m, rad] in the base frame at `t_ns`."""


class AnalyticWorld:
    """Closed-form contact with its history.

    Args:
        spec: The sensor and the indenter.
        contact_frame: Pose (6,) of the contact frame in the base frame [m, rad].
    """

    def __init__(self, spec: AnalyticSpec, contact_frame: tuple[float, ...]) -> None:
        self._spec = spec
        self._origin = np.array(contact_frame[:3])
        self._rotation = matrix_from_vector(np.array(contact_frame[3:]))
        self._anchor: np.ndarray | None = None
        self._branch = np.zeros(3)
        self._elastic = np.zeros(3)
        self._t_ns: int | None = None

    def step(self, t_ns: int, pose: np.ndarray) -> np.void:
        """Return the next state; times must not decrease.

        Args:
            t_ns: Time of the pose [ns].
            pose: TCP in the base frame (6,) [m, rad].
        """
        tip = self._rotation.T @ (np.asarray(pose[:3]) - self._origin)
        depth = dome_height(self._spec.dome_radius, *tip[:2].tolist()) - float(tip[2])
        elastic, shear = self._elastic_force(tip[:2], depth)
        force = elastic if self._spec.hysteresis is None else self._relaxed(t_ns, elastic)
        if depth <= 0:
            force = np.zeros(3)
        # Force on the sensor: pressing down is negative z, dragging is along the drag.
        wrench = np.concatenate([force, np.zeros(3)])
        top = depth + float(tip[2])
        lever = np.array([tip[0], tip[1], self._spec.gauge_depth + top])
        wrench[3:] = np.cross(lever, force)
        state: np.void = np.zeros(1, WORLD_STATE)[0]
        state["t_ns"] = t_ns
        state["pose"] = pose
        state["depth"] = depth
        state["contact"] = tip[:2]
        state["shear"] = shear
        state["wrench"] = wrench
        if (taxels := self._spec.taxels) is not None:
            moved = self.surface(state).displacement(taxels.positions())
            state["taxels"] = taxels.counts(moved)
        return state

    def surface(self, state: np.void) -> PressedSurface:
        """Return the deformed surface of `state`."""
        return surface_of(self._spec, state)

    def _elastic_force(self, position: np.ndarray, depth: float) -> tuple[np.ndarray, np.ndarray]:
        """Return elastic force (3,) on the sensor [N], tangential surface displacement (2,) [m]."""
        spec = self._spec
        if depth <= 0:
            self._anchor = None
            return np.zeros(3), np.zeros(2)
        normal = spec.indenter.force(spec.layer, depth)
        if spec.friction is None:
            return np.array([0.0, 0.0, -normal]), np.zeros(2)
        if self._anchor is None:
            self._anchor = position.copy()
        radius = spec.indenter.contact_radius(spec.layer, depth)
        stiffness = spec.layer.disc_shear_stiffness(radius)
        shear = position - self._anchor
        limit = spec.friction * normal
        drag = stiffness * math.hypot(*shear)
        if drag > limit:
            # Slip: the anchor follows until the drag equals the friction limit.
            shear = shear * (limit / drag)
            self._anchor = position - shear
        return np.array([*(stiffness * shear), -normal]), shear

    def _relaxed(self, t_ns: int, elastic: np.ndarray) -> np.ndarray:
        """Return elastic force plus Maxwell branch, exact for a force linear over the step."""
        hysteresis = self._spec.hysteresis
        if hysteresis is None:
            return elastic
        if self._t_ns is not None:
            step = max((t_ns - self._t_ns) * 1e-9, 0.0)
            decay = math.exp(-step / hysteresis.relaxation)
            gain = hysteresis.relaxation * (1 - decay) / step if step > 0 else 1.0
            change = elastic - self._elastic
            self._branch = decay * self._branch + hysteresis.fraction * gain * change
        self._t_ns, self._elastic = t_ns, elastic
        force = elastic + self._branch
        # The layer does not pull: the branch's remainder after release is no adhesion.
        force[2] = min(force[2], 0.0)
        return force


def surface_of(spec: AnalyticSpec, state: np.void) -> PressedSurface:
    """Return the deformed surface of a WORLD_STATE."""
    depth = max(float(state["depth"]), 0.0)
    return PressedSurface(
        centre=(float(state["contact"][0]), float(state["contact"][1])),
        depth=depth,
        radius=spec.indenter.contact_radius(spec.layer, depth) if depth > 0 else 0.0,
        thickness=spec.layer.thickness,
        shear=(float(state["shear"][0]), float(state["shear"][1])),
    )
