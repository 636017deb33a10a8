"""A hand of two fingers, the objects that it grasps, and its bench file.

The hand's frame: x from the left skin to the right one along the grip axis, z along the fingers
towards their tips, y completes it.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from rig.bench.bench import (
    READER,
    BenchStream,
    Preflight,
    StreamBench,
    filled,
    find_bench,
    read_content,
)
from rig.bench.expected import Skin, expected_force
from rig.bench.indenter import find_indenter
from rig.bench.worlds import WorldSpec
from rig.core.errors import ConfigError
from rig.core.names import plain_name
from rig.core.stream_settings import StreamSettings
from rig.devices.gripper.settings import HandConfig
from trajectories import Squeeze

# Names of the fingers, in the order of every array of a hand.
FINGERS = ("left", "right")


@dataclass(frozen=True, slots=True)
class GraspObject:
    """Rigid object between two fingers, with the shape of an indenter on each side.

    Raises:
        ValueError: A value is out of range.
    """

    name: str
    faces: tuple[str, str] = ("cylinder", "cylinder")
    """Indenters whose tips touch the left and the right skin."""
    width: float = field(default=0.04, metadata={"unit": "mm", "plausible": (1, 140)})
    """Distance between the tips of both faces [m]."""
    mass: float = field(default=0.05, metadata={"unit": "kg", "plausible": (0.001, 5)})
    """Mass [kg]."""
    friction: float = 1.0
    """Friction of its faces over that of the skin's row."""

    def __post_init__(self) -> None:
        for name in ("width", "mass"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: {getattr(self, name)!r}; allowed: above 0")
        _check_not_negative(self, "friction")


@dataclass(frozen=True, slots=True)
class PairSpec:
    """Two skins in one hand.

    Raises:
        ValueError: The compliance is negative.
    """

    left: WorldSpec
    right: WorldSpec
    compliance: float = 2e-5
    """Way by which each finger bends per grip force [m/N]; assumed, no hand was measured."""

    def __post_init__(self) -> None:
        _check_not_negative(self, "compliance")


def _check_not_negative(one: object, name: str) -> None:
    if not (value := getattr(one, name)) >= 0:
        raise ValueError(f"{name}: {value!r}; allowed: 0 or more")


@dataclass(frozen=True, slots=True)
class Finger:
    """Sensor on a finger; its settings are those of the bench file of its name."""

    sensor: str
    """Name of the sensor's own bench file."""
    device: StreamSettings
    """Its camera or taxels."""
    depth_max: float = field(metadata={"unit": "mm"})
    """Deepest press of its plan [m]."""
    world: WorldSpec | None = None
    """Its simulation, on a mock bench."""


@dataclass(frozen=True, slots=True)
class PairBench(StreamBench):
    """Complete settings of a bench with a hand.

    Raises:
        ValueError: Values contradict each other.
    """

    sensor: str
    """Name of the bench, and of its sessions."""
    description: str
    mock: bool
    """True if the devices are emulators; written into every session."""
    rate_hz: float
    """Rate of the synchronised view."""
    arm: Literal["none"]
    """The hand is still, or moved by people."""
    fingers: dict[str, Finger]
    """The sensors `left` and `right`, which are streams of these names."""
    gripper: HandConfig
    objects: tuple[GraspObject, ...]
    squeeze: Squeeze = field(default_factory=Squeeze)
    preflight: Preflight = field(default_factory=Preflight)
    compliance: float = 2e-5
    """Way by which each finger bends per grip force, of a mock's hand [m/N]."""

    def __post_init__(self) -> None:
        _check_not_negative(self, "compliance")
        if tuple(self.fingers) != FINGERS:
            raise ValueError(f"fingers: found {', '.join(self.fingers)}; allowed: left, right")
        if self.mock != all(finger.world is not None for finger in self.fingers.values()):
            raise ValueError("mock: allowed: true with sensors of mock benches")
        most = sum(finger.depth_max for finger in self.fingers.values())
        if self.squeeze.deepest > most:
            raise ValueError(
                f"squeeze: closes by {1e3 * self.squeeze.deepest:g} mm; allowed: up to "
                f"{1e3 * most:g} mm, the depths of both sensors"
            )
        names = [each.name for each in self.objects]
        if not names or len({*names}) < len(names):
            raise ValueError(f"objects: found {names}; allowed: one or more, each name once")
        gripper, squeeze = self.gripper, self.squeeze
        if squeeze.step < gripper.per_count * (1 - 1e-9):
            raise ValueError(
                f"squeeze.step_mm: {1e3 * squeeze.step:g}; allowed: {1e3 * gripper.per_count:g}, "
                "one count of the gripper, or more"
            )
        least = squeeze.deepest
        most = gripper.opening(0) - squeeze.clearance
        for each in self.objects:
            plain_name("objects.name", each.name)
            for face in each.faces:
                find_indenter(face)
            if not least < each.width <= most:
                raise ValueError(
                    f"objects.{each.name}.width_mm: {1e3 * each.width:g}; allowed: above "
                    f"{1e3 * least:g} (the deepest step) to {1e3 * most:g} (open, with clearance)"
                )

    def check_depths(self) -> None:
        """Reject a squeeze that presses a skin of a mock deeper than its sensor's plan does.

        Raises:
            ConfigError: It does; the faces of an object divide its closing by their stiffness.
        """
        for each in self.objects:
            curves = [
                expected_force(Skin(finger.world.sensor), face, exact=True)
                for finger, face in zip(self.fingers.values(), each.faces, strict=True)
                if finger.world is not None
            ]
            for force in np.linspace(0.0, 50.0, 1001):
                depths = [curve.depth_of(float(force))[0] for curve in curves]
                if sum(depths) + 2 * self.compliance * force >= self.squeeze.deepest:
                    break
            for (name, finger), depth in zip(self.fingers.items(), depths, strict=True):
                if depth > finger.depth_max:
                    raise ConfigError(
                        f"squeeze: presses {each.name} {1e3 * depth:.2f} mm into the {name} skin; "
                        f"allowed: {1e3 * finger.depth_max:g}: fewer steps, or faces more alike"
                    )

    @property
    def rows(self) -> tuple[BenchStream, ...]:
        """Streams of the fingers and of the gripper."""
        fingers = [BenchStream(name, finger.device) for name, finger in self.fingers.items()]
        return (*fingers, BenchStream("gripper", self.gripper))


@dataclass(frozen=True, slots=True)
class PairFile:
    """A bench file of a hand, and the bench that is built of its content."""

    path: Path
    content: dict[str, Any]
    """Content with the settings of both sensors."""
    bench: PairBench

    @classmethod
    def of(cls, content: dict[str, Any], path: Path) -> Self:
        """Build the bench of a content with the settings of both sensors."""
        bench = READER.build(PairBench, content, str(path))
        plain_name(f"{path}.sensor", bench.sensor)
        return cls(path, content, bench)

    @classmethod
    def of_sensors(cls, content: dict[str, Any], path: Path) -> Self:
        """Build the bench of a content as read from YAML, whose fingers name their sensors."""
        fingers = content.get("fingers")
        if not isinstance(fingers, dict):
            raise ConfigError(f"{path}.fingers: found {fingers!r}; allowed: left and right")
        read = {name: _finger(fingers[name], f"{path}.fingers.{name}") for name in sorted(fingers)}
        if not content.get("mock"):
            read = {name: {**each, "world": None} for name, each in read.items()}
        file = cls.of({**content, "fingers": read}, path)
        if file.bench.mock:
            file.bench.check_depths()
        return file

    def at(self, hosts: dict[str, str], folder: Path) -> Self:
        """Return the file with the host of each finger's emulator, and the run folder, filled in.

        That of any other device is `hosts["left"]`.
        """
        content = filled(self.content, "loopback", folder)
        fingers = {
            name: filled(each, hosts[name], folder) for name, each in content["fingers"].items()
        }
        return self.of({**content, "fingers": fingers}, self.path)


def _finger(own: Any, where: str) -> dict[str, Any]:
    """Return the settings of a finger from its sensor's bench file, with its `own`."""
    if not isinstance(own, dict) or not isinstance(own.get("sensor"), str):
        raise ConfigError(f"{where}.sensor: missing; allowed: the name of a sensor's bench file")
    path = find_bench(own["sensor"], where=f"{where}.sensor")
    content = read_content(path)
    device = content.get("camera") or content.get("taxels")
    if not isinstance(device, dict) or "depth_max_mm" not in (content.get("limits") or {}):
        raise ConfigError(f"{where}.sensor: {path} has no camera or taxels, or no depth_max_mm")
    given = own.get("device") or {}
    if not isinstance(given, dict):
        raise ConfigError(f"{where}.device: found {given!r}; allowed: keys of its camera or taxels")
    same = given.get("kind", device.get("kind")) == device.get("kind")
    return {
        "depth_max_mm": content["limits"]["depth_max_mm"],
        "world": content.get("world"),
        **own,
        "device": {**device, **given} if same else given,
    }
