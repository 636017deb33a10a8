"""What makes two sensors of one design differ in life. Each is off unless asked for.

Every draw depends on the seed and on names alone: the same sensor is mounted in the same way in
whatever order, process or subset it is simulated.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sim.checks import check_range
from sim.motion import Motion
from sim.sensors.field import SurfaceField
from sim.sensors.seeds import generator
from sim.sensors.segmentation import Segmentation

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a sensor sits under the robot, against where the robot believes it to be."""

    shift_x: float = 0.0
    """The middle of its top along the robot's x [m]."""
    shift_y: float = 0.0
    """The same along y [m]."""
    turn: float = 0.0
    """How far its x lies from the robot's, anticlockwise [rad]."""

    def motion(self, motion: Motion) -> Motion:
        """The robot's motion, about the middle of the sensor: what a scene is simulated with.

        Axes stay the robot's, so that the indenter and the forces need no turn; `field` makes the
        turn. The sides of the body are taken to lie along the robot's axes, `turn` or not.
        """
        tip = tuple((x - self.shift_x, y - self.shift_y, z) for x, y, z in motion.tip)
        return replace(motion, tip=tip)

    def field(self, field: SurfaceField) -> SurfaceField:
        """The deformation of that scene in the sensor's own frame: what its camera sees."""
        return field.turned(self.turn)


@dataclass(frozen=True, slots=True)
class Mount:
    """A sensor screwed down askew: presses land elsewhere on it. Drawn once for each sensor.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    shift: float = field(metadata={"unit": "mm"})
    """Most that it is shifted along x, and along y; evenly drawn [m], 0 to 0.01."""
    turn: float = field(metadata={"unit": "deg"})
    """Most that it is turned about its axis either way; evenly drawn [rad], 0 to 0.2."""

    def __post_init__(self) -> None:
        check_range("mount", "shift", self.shift, 0.0, 0.01, unit="m")
        check_range("mount", "turn", self.turn, 0.0, 0.2, unit="rad")

    def drawn(self, seed: int, sensor: str) -> Placement:
        """Where `sensor` sits."""
        x, y, turn = generator(seed, "mount", sensor).uniform(-1.0, 1.0, 3).tolist()
        return Placement(self.shift * x, self.shift * y, self.turn * turn)


@dataclass(frozen=True, slots=True)
class Framing:
    """A camera that looks a little beside the gel: only the image moves. Drawn for each sensor.

    Raises:
        SceneError: A value outside of what is allowed.
    """

    shift_px: float
    """Most that the image is shifted along columns, and along rows; evenly drawn, 0 to 100."""
    turn: float = field(metadata={"unit": "deg"})
    """Most that it is turned about its middle either way; evenly drawn [rad], 0 to 0.2."""

    def __post_init__(self) -> None:
        check_range("framing", "shift_px", self.shift_px, 0.0, 100.0, unit="px")
        check_range("framing", "turn", self.turn, 0.0, 0.2, unit="rad")

    def drawn(self, seed: int, sensor: str) -> tuple[float, float, float]:
        """Shift along columns and along rows [px], and turn [rad], of the camera of `sensor`."""
        column, row, turn = generator(seed, "framing", sensor).uniform(-1.0, 1.0, 3).tolist()
        return self.shift_px * column, self.shift_px * row, self.turn * turn


@dataclass(frozen=True, slots=True)
class Drift:
    """A skin that creeps as a session goes on, so that untouched images differ between points.

    Raises:
        SceneError: A step outside of what is allowed.
    """

    step: float = field(metadata={"unit": "um"})
    """Standard deviation along x, and along y, of how far the whole skin creeps from one contact
    point to the next [m], 0 to 1e-3: a random walk that begins at 0."""

    def __post_init__(self) -> None:
        check_range("drift", "step", self.step, 0.0, 1e-3, unit="m")

    def drawn(self, points: int, seed: int, *session: str | int) -> Array:
        """Offset (points, 2) [m] of the skin at each contact point of a session, in their order.

        Args:
            points: How many contact points there are.
            seed: Of all draws.
            session: What tells this session from others, such as sensor and indenter.
        """
        steps = generator(seed, "drift", *session).normal(0.0, self.step, (points, 2))
        steps[:1] = 0.0
        offsets: Array = np.cumsum(steps, axis=0)
        return offsets


@dataclass(frozen=True, slots=True)
class Grip:
    """A gripper that holds the indenter askew. Drawn for each indenter it takes.

    Raises:
        SceneError: A tilt outside of what is allowed.
    """

    tilt: float = field(metadata={"unit": "deg"})
    """Most that the indenter leans about x, and about y; evenly drawn [rad], 0 to 0.25."""

    def __post_init__(self) -> None:
        check_range("grip", "tilt", self.tilt, 0.0, 0.25, unit="rad")

    def drawn(self, seed: int, sensor: str, indenter: str) -> tuple[float, float]:
        """Lean about x and about y [rad] of `indenter` while it is pressed into `sensor`."""
        x, y = generator(seed, "grip", sensor, indenter).uniform(-1.0, 1.0, 2).tolist()
        return self.tilt * x, self.tilt * y


@dataclass(frozen=True, slots=True)
class Life:
    """What tells a sensor in use from its drawing. None is off."""

    mount: Mount | None = None
    """The sensor sits askew under the robot: other deformations."""
    grip: Grip | None = None
    """The indenter leans: other deformations."""
    framing: Framing | None = None
    """The camera looks beside the gel: other images of the same deformation."""
    drift: Drift | None = None
    """The skin creeps: other references."""
    segmentation: Segmentation | None = None
    """Markers are not found exactly."""
