"""Simulated sensor as a row of data: a body, its effects and its signal."""

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Self

import numpy as np

from recorder.settings import Reader
from sim.errors import SceneError, check_range
from sim.indenters import Indenter
from sim.markers import Camera, Pattern, named
from sim.scene import Body, Effects, Motion, Scene
from sim.sensors.pins import Pins
from sim.sensors.posterior import Posterior
from sim.sensors.taxels import TaxelPad, TaxelSignal
from sim.sensors.variation import DeviceVariation
from trajectories import ForceDepth, PressShear


@dataclass(frozen=True, slots=True)
class CameraSignal:
    """Camera below the gel that images markers.

    Raises:
        SceneError: There is no pattern, an unknown one or one besides `layout`, or neither scale
            nor distance.
    """

    KIND: ClassVar[str] = "camera"

    patterns: tuple[str, ...]
    """Names of marker patterns (`sim.markers`); each of several gives separate images."""
    scale: float | None = field(default=None, metadata={"unit": "mm_per_px"})
    """Size of a pixel on the undeformed top [m/px]; without it that of the paper's lens at
    `distance`."""
    distance: float | None = field(default=None, metadata={"unit": "mm"})
    """Distance from the pinhole to the undeformed top, or to the undeformed tips of pins [m];
    without it that at which the paper's lens has the scale."""
    pins: Pins | None = None
    """Pins under the skin, whose tips are the markers; None: markers are on the skin."""
    layout: Pattern | None = field(default=None, metadata={"stored": "unless default"})
    """Markers of a sensor whose pattern has no name in `sim.markers`; `patterns` has its name."""
    shift_px: tuple[float, float] = field(default=(0.0, 0.0), metadata={"stored": "unless default"})
    """Shift of the image, to the right and downwards [px]: where the camera sees the middle."""
    rotation: float = field(default=0.0, metadata={"unit": "deg", "stored": "unless default"})
    """Rotation of the image before the shift, anticlockwise about its middle [rad]."""
    tilt: tuple[float, float] = field(
        default=(0.0, 0.0), metadata={"unit": "deg", "stored": "unless default"}
    )
    """Tilt of the camera about x and y [rad]; the gel's axis stays in the middle of the image."""

    def __post_init__(self) -> None:
        if not self.patterns:
            raise SceneError("signal.patterns: none; allowed: one or more names")
        if self.layout is None:
            for name in self.patterns:
                named(name)
        elif self.patterns != (self.layout.name,):
            raise SceneError(
                f"signal.patterns: {', '.join(self.patterns)}; allowed: {self.layout.name}, the "
                "name of the layout"
            )
        if self.scale is None and self.distance is None:
            raise SceneError("signal: neither scale nor distance; allowed: one, or both")
        self.camera()

    def camera(self) -> Camera:
        """Return the camera in its nominal mounting."""
        if self.distance is None:
            lens = Camera.of_scale((self.scale or 0.0) * 1e3)
        elif self.scale is None:
            lens = Camera(distance=self.distance)
        else:
            check_range("signal", "scale", self.scale, 1e-7, 1e-2, unit="m/px")
            lens = Camera(self.distance / self.scale, self.distance)
        return replace(lens, shift=self.shift_px, rotation=self.rotation, tilt=self.tilt)

    def drawn(self) -> tuple[Pattern, ...]:
        """Return the patterns."""
        if self.layout is not None:
            return (self.layout,)
        return tuple(named(name) for name in self.patterns)

    def mounted(self, camera: Camera) -> Self:
        """Return the signal of another camera; markers stay on the body."""
        return replace(
            self,
            scale=1e-3 * camera.mm_per_px,
            distance=camera.distance,
            shift_px=camera.shift,
            rotation=camera.rotation,
            tilt=camera.tilt,
        )

    def by(self, camera: Camera, body: Body) -> Self:
        """Return the signal of another camera that sees the same image without contact.

        A layout moves on the body, since its markers are known by their places in that image;
        those that end beyond the body are dropped. Named patterns stay where they are.
        """
        signal, layout = self.mounted(camera), self.layout
        if layout is None:
            return signal
        heights = body.heights_at(*layout.centres.T)
        pixels = self.camera().project(np.column_stack([layout.centres, heights]))
        moved = replace(
            layout,
            size=layout.size * camera.mm_per_px / self.camera().mm_per_px,
            places=tuple(map(tuple, camera.places(pixels, body).tolist())),
            angle=math.remainder(layout.angle + self.rotation - camera.rotation, math.tau),
        )
        return replace(signal, layout=moved.within(body))


@dataclass(frozen=True, slots=True)
class SimulatedSensor:
    """Complete description of a simulated sensor; `sim.sensors.sensor` reads them by name.

    Raises:
        SceneError: Values are inconsistent.
    """

    name: str
    description: str
    """Description in one line."""
    body: Body
    """Soft body that is touched."""
    signal: CameraSignal | TaxelSignal
    """Signal that is measured from its deformation."""
    depth_max: float = field(metadata={"unit": "mm"})
    """Deepest press that the sensor is meant for [m]."""
    effects: Effects = field(default_factory=Effects)
    """Effects beyond elasticity."""
    film: float = field(default=0.0, metadata={"unit": "mm"})
    """Thickness of a stiff skin on the body [m], also the least radius to which it bends. Edges of
    an indenter are rounded to it, or as far as the indenter has room."""
    speed: float = field(default=5e-3, metadata={"unit": "mm_s"})
    """Speed of the tip while pressing [m/s], at which the viscosity was fitted."""
    trajectory: PressShear | None = None
    """Recorded presses; None without such a recording."""
    force_depth: ForceDepth | None = None
    """Presses that relate force and depth, for material compensation."""
    variation: DeviceVariation = field(default_factory=DeviceVariation)
    """Deviations of this device from its design; all off by default."""
    posterior: Posterior | None = field(default=None, metadata={"stored": "unless default"})
    """Uncertainty of a twin, a row identified from presses; None of a design."""

    def __post_init__(self) -> None:
        deepest = 0.9 * self.body.thickness
        check_range(self.name, "depth_max", self.depth_max, 0.0, deepest, unit="m", open_low=True)
        check_range(self.name, "speed", self.speed, 0.0, 10.0, unit="m/s", open_low=True)
        check_range(self.name, "film", self.film, 0.0, self.body.thickness, unit="m")
        for name in ("trajectory", "force_depth"):
            plan = getattr(self, name)
            if plan is not None and plan.depth_max > self.depth_max * (1 + 1e-9):
                raise SceneError(
                    f"{self.name}.{name}.depth_max: {plan.depth_max:g} m; allowed: up to this "
                    f"sensor's depth_max, {self.depth_max:g} m"
                )
        domed = self.trajectory is not None and self.trajectory.dome_radius is not None
        if domed and self.body.dome_radius is not None:
            raise SceneError(
                f"{self.name}.trajectory.dome_radius: found one beside body.dome_radius; allowed: "
                "one of both, a flat body is pressed as if it lay at the height of the dome"
            )
        if isinstance(self.signal, TaxelSignal):
            TaxelPad(self.body, self.signal)
            return
        for pattern in self.signal.drawn():
            pattern.check_within(self.body)
        if self.signal.pins is not None and self.body.dome_radius is not None:
            raise SceneError(
                f"{self.name}.body.dome_radius: {self.body.dome_radius!r} m with pins; allowed: "
                "None, pins are drawn under a flat skin"
            )

    def scene(self, indenter: Indenter, motion: Motion) -> Scene:
        """Return the scene of an indenter and a motion, both given in the sensor's frame.

        Raises:
            SceneError: The motion is deeper than `depth_max`.
        """
        if motion.depth_max > self.depth_max * (1 + 1e-9):
            raise SceneError(
                f"motion: {motion.depth_max * 1e3:.4g} mm deep into {self.name}; allowed: up to "
                f"{self.depth_max * 1e3:.4g} mm"
            )
        if 0 < indenter.edge_radius < self.film:  # the film rounds edges
            indenter = replace(indenter, edge_radius=min(self.film, indenter.edge_radius_max))
        return Scene(indenter, motion, body=self.body, effects=self.effects)

    def placed(self, indenter: Indenter, motion: Motion, *, seed: int) -> Scene:
        """Return the scene of a motion with mount and grip drawn at random from `variation`.

        `Mount.drawn(seed, name).field` then transforms its deformation to the sensor's frame.
        """
        if self.variation.mount is not None:
            motion = self.variation.mount.drawn(seed, self.name).motion(motion)
        if self.variation.grip is not None:
            about_x, about_y = self.variation.grip.drawn(seed, self.name, indenter.name)
            indenter = indenter.tilted(about_x, about_y)
        return self.scene(indenter, motion)


# Sensors that come with the simulator, by name, and sensors from the user's files.

READER = Reader(SceneError)

# One file per sensor, named as the sensor.
ROWS = Path(__file__).parent / "rows"

# Names that `sensor` accepts.
NAMES: tuple[str, ...] = tuple(sorted(path.stem for path in ROWS.glob("*.yaml")))

# The paper's five GelSights of one material with different markers.
HOMOGENEOUS = ("array-i", "array-ii", "circle-i", "circle-ii", "diamond-i")
# The paper's seven skins of different hardness, from hard to soft.
MATERIAL = ("r6", "r8", "r10", "r12", "r14", "r16", "r18")
# The paper's three kinds of sensors, from hard to soft.
HETEROGENEOUS = ("uskin", "gelsight", "tacpalm")


def sensor(name: str) -> SimulatedSensor:
    """Return the sensor of that name.

    Raises:
        SceneError: The name is unknown.
    """
    if name not in NAMES:
        raise SceneError(f"sensor: {name!r}; allowed: {', '.join(NAMES)}")
    return read_sensor(ROWS / f"{name}.yaml")


def sensor_of(text: str) -> SimulatedSensor:
    """Return the sensor of a YAML file, by its path, or of the row with that name.

    Raises:
        SceneError: The name is unknown, or the file is invalid.
    """
    return read_sensor(Path(text)) if text.endswith((".yaml", ".yml")) else sensor(text)


def read_sensor(path: Path) -> SimulatedSensor:
    """Read the sensor that a YAML file describes; its name is that of the file.

    A file may extend one of the rows that come with the simulator: `extends: gelsight.yaml`.

    Raises:
        SceneError: The file is invalid; the message names the file and the key.
    """
    content = READER.read(path, library=ROWS)
    if "name" in content:
        raise SceneError(f"{path}: unknown ['name']; a sensor is named as its file is")
    return READER.build(SimulatedSensor, {"name": path.stem, **content}, str(path))
