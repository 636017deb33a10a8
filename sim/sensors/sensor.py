"""A simulated sensor is a row of data: a body, effects on it, and what is measured of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

from sim.effects import Effects
from sim.errors import SceneError, check_range
from sim.indenters import Indenter
from sim.markers import Camera, Pattern, named
from sim.scene import Body, Motion, Scene
from sim.sensors.config import build, read_mapping
from sim.sensors.optics import Pins, Shading
from sim.sensors.taxels import TaxelPad, TaxelSignal
from sim.sensors.variation import Life
from trajectories import ForceDepth, PressShear


@dataclass(frozen=True, slots=True)
class CameraSignal:
    """A camera below the gel that sees markers.

    Raises:
        SceneError: No pattern, one that is unknown, or not just one of scale and distance.
    """

    KIND: ClassVar[str] = "camera"

    patterns: tuple[str, ...]
    """Patterns of markers by name (`sim.markers`); with several, each makes images of its own."""
    scale: float | None = field(default=None, metadata={"unit": "mm_per_px"})
    """What a pixel sees of the untouched top [m/px], or else:"""
    distance: float | None = field(default=None, metadata={"unit": "mm"})
    """From the pinhole to the untouched top, or to the untouched tips of pins [m]."""
    pins: Pins | None = None
    """Pins under the skin, whose tips are the markers; None: markers are on the skin."""
    shading: Shading | None = None
    """Lamps, for pictures in colour; None has marker images only."""

    def __post_init__(self) -> None:
        if not self.patterns:
            raise SceneError("signal.patterns: none; allowed: one or more names")
        for name in self.patterns:
            named(name)
        if (self.scale is None) == (self.distance is None):
            raise SceneError(
                f"signal: scale {self.scale!r} and distance {self.distance!r}; allowed: one of both"
            )
        if self.pins is not None and self.shading is not None:
            raise SceneError("signal.shading: lamps with pins; allowed: lamps on a bare skin")
        self.camera()

    def camera(self) -> Camera:
        """The camera, as it was meant to be mounted."""
        if self.distance is not None:
            return Camera(distance=self.distance)
        return Camera.of_scale((self.scale or 0.0) * 1e3)

    def drawn(self) -> tuple[Pattern, ...]:
        """The patterns."""
        return tuple(named(name) for name in self.patterns)


@dataclass(frozen=True, slots=True)
class SimulatedSensor:
    """Everything that a simulated sensor is. Rows of them: `sim.sensors.sensor`.

    Raises:
        SceneError: Values that do not fit each other.
    """

    name: str
    description: str
    """What it stands for, in a line."""
    body: Body
    """The soft part that is touched."""
    signal: CameraSignal | TaxelSignal
    """What is measured of its deformation."""
    depth_max: float = field(metadata={"unit": "mm"})
    """Deepest press that it is meant for [m]."""
    effects: Effects = field(default_factory=Effects)
    """What happens in it beyond elasticity."""
    film: float = field(default=0.0, metadata={"unit": "mm"})
    """Thickness of a stiff skin on the body [m]: it bends round no edge more sharply than that, so
    that every edge of an indenter is rounded as far, or as far as the indenter has room for."""
    speed: float = field(default=5e-3, metadata={"unit": "mm_s"})
    """Speed of the tip while it presses [m/s]; the viscosity was fitted at this one."""
    trajectory: PressShear | None = None
    """The recorded presses; None where there is no such recording."""
    force_depth: ForceDepth | None = None
    """The press that relates force and depth, for material compensation."""
    life: Life = field(default_factory=Life)
    """What tells this one from its drawing; all off unless asked for."""

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
        """The scene of this indenter on this motion, both as the sensor's frame has them.

        Raises:
            SceneError: Deeper than the sensor is meant for.
        """
        if motion.depth_max > self.depth_max * (1 + 1e-9):
            raise SceneError(
                f"motion: {motion.depth_max * 1e3:.4g} mm deep into {self.name}; allowed: up to "
                f"{self.depth_max * 1e3:.4g} mm"
            )
        return Scene(self._felt(indenter), motion, body=self.body, effects=self.effects)

    def _felt(self, indenter: Indenter) -> Indenter:
        """The indenter as it is on the inner side of the film; one without edges stays itself."""
        if not 0 < indenter.edge_radius < self.film:
            return indenter
        return replace(indenter, edge_radius=min(self.film, indenter.edge_radius_max))

    def placed(self, indenter: Indenter, motion: Motion, *, seed: int) -> Scene:
        """The scene that the robot makes of this motion: mount and grip of its life are drawn.

        `Mount.drawn(seed, name).field` then takes its deformation to what the sensor sees.
        """
        if self.life.mount is not None:
            motion = self.life.mount.drawn(seed, self.name).motion(motion)
        if self.life.grip is not None:
            about_x, about_y = self.life.grip.drawn(seed, self.name, indenter.name)
            indenter = indenter.tilted(about_x, about_y)
        return self.scene(indenter, motion)


# The sensors that come with the simulator, by name, and sensors from files of one's own.

# A file a sensor; its name is the sensor's.
ROWS = Path(__file__).parent / "rows"

# The names that `sensor` knows.
NAMES: tuple[str, ...] = tuple(sorted(path.stem for path in ROWS.glob("*.yaml")))

# The paper's five GelSights of one material and different markers.
HOMOGENEOUS = ("array-i", "array-ii", "circle-i", "circle-ii", "diamond-i")
# Its seven skins of different hardness, from hard to soft.
MATERIAL = ("r6", "r8", "r10", "r12", "r14", "r16", "r18")
# Its three kinds of sensors, from hard to soft.
HETEROGENEOUS = ("uskin", "gelsight", "tacpalm")


def sensor(name: str) -> SimulatedSensor:
    """The sensor of that name.

    Raises:
        SceneError: No such name.
    """
    if name not in NAMES:
        raise SceneError(f"sensor: {name!r}; allowed: {', '.join(NAMES)}")
    return read_sensor(ROWS / f"{name}.yaml")


def read_sensor(path: Path) -> SimulatedSensor:
    """The sensor that a YAML file describes; it is named as the file is.

    Raises:
        SceneError: Names the file and the key of what is wrong.
    """
    content = read_mapping(path)
    if "name" in content:
        raise SceneError(f"{path}: unknown ['name']; a sensor is named as its file is")
    return build(SimulatedSensor, {"name": path.stem, **content}, str(path))
