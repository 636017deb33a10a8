"""LadderWorld: the paper's experiment by superposed presses, light enough for every cycle."""

import math
from collections.abc import Sequence

import numpy as np

from rig.bench.worlds import Grip, WorldSpec
from rig.core.clock import SECOND_NS
from rig.mock.world.contact import ContactFrame, tip_of
from rig.mock.world.lab import Skin
from rig.mock.world.sensors import dome_of, ladder_of, ladder_press, row_of


class LadderWorld:
    """Moves a press of `sim.ladder` along the arm's path; `contact_frame` is in the base."""

    def __init__(self, spec: WorldSpec, indenter: str, contact_frame: tuple[float, ...]) -> None:
        dome = dome_of(row_of(spec), spec.tier)
        self._frame = ContactFrame(contact_frame, dome, spec.gauge_depth)
        self._press = ladder_press(spec, indenter)
        self._held = None if spec.grip is None else Held(spec.grip)
        self._skin = Skin(spec.lab)
        self._t_ns: int | None = None

    def step(self, t_ns: int, pose: np.ndarray) -> np.void:
        """Return the state at `t_ns` of the TCP at `pose` (6,) in the base frame [m, rad]."""
        tip = self._frame.tip(pose)
        if self._held is not None:
            tip = tip + self._held.given
        seconds = 0.0 if self._t_ns is None else (t_ns - self._t_ns) / SECOND_NS
        self._t_ns = t_ns
        self._press.move(tip, seconds)
        wrench = self._skin.wrench(self._press.wrench, tip, seconds)
        if self._held is not None:
            self._held.bear(-wrench[:3])
        return self._frame.state(t_ns, pose, tip, self._press.shear, wrench)


class Held:
    """Displacement of an indenter between a gripper's fingers."""

    def __init__(self, grip: Grip) -> None:
        self._grip = grip
        self._slid = np.zeros(3)
        self.given: np.ndarray = np.zeros(3)
        """Displacement from its place in the fingers (3,) [m]."""

    def bear(self, force: np.ndarray) -> None:
        """Give way to a force on the indenter (3,) [N]; beyond the grip it slides and stays there.

        The displacement follows with half of its change, so that a skin as stiff as the grip does
        not make it oscillate from one cycle to the next.
        """
        most, size = self._grip.slip, math.hypot(*force)
        if size > most:
            self._slid += force * ((size - most) / size / self._grip.stiffness)
            force = force * (most / size)
        self.given += 0.5 * (self._slid + force / self._grip.stiffness - self.given)


class LadderSurface:
    """Displacement of a skin's points for the states that a LadderWorld or a hand publishes.

    `faces` are indenter and friction factor of each object of a hand, by its number.

    It presses along the tips of the states that it is given: the way between two is straight.
    """

    def __init__(
        self,
        spec: WorldSpec,
        indenter: str,
        points: np.ndarray,
        faces: Sequence[tuple[str, float]] = (),
    ) -> None:
        faces = faces or ((indenter, 1.0),)
        self._ladders = {face: ladder_of(spec, face) for face in dict(faces)}
        for ladder in self._ladders.values():
            ladder.fields  # noqa: B018, takes a while when it is first used
        self._spec, self._faces, self._points = spec, faces, points
        self._object = -1
        self._t_ns: int | None = None

    def __call__(self, state: np.void) -> np.ndarray:
        """Return the displacement (n, 3) [m] of the points."""
        if self._object != (number := int(state["object"])):
            self._object, self._t_ns = number, None
            face, friction = self._faces[number]
            self._press = ladder_press(self._spec, face, friction, self._ladders[face])
        t_ns = int(state["t_ns"])
        if t_ns != self._t_ns:
            seconds = 0.0 if self._t_ns is None else (t_ns - self._t_ns) / SECOND_NS
            self._t_ns = t_ns
            self._press.move(tip_of(state), max(seconds, 0.0))
        return np.asarray(self._press.markers(self._points))
