"""World of the mock bench: turns the arm's motion into states that the emulators measure."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rig.bench.worlds import WorldSpec
from rig.core.config import build, read_yaml
from rig.core.emulation import require_loopback
from rig.mock.world.contact import World, tip_of
from rig.mock.world.ladder import LadderSurface, LadderWorld
from rig.mock.world.sensors import pad_of
from rig.mock.world.simulated import Between, SimulatedSurface, SimulatedWorld
from rig.mock.world.views import reading_of


@dataclass(frozen=True, slots=True)
class WorldConfig:
    """Settings of the processes of a World, and of its views."""

    world: WorldSpec
    contact_frame: tuple[float, ...] = field(metadata={"pose": True})
    """Pose (6,) in the base frame [m, rad]."""
    folder: Path
    """Run folder with the shared records."""
    indenter: str = ""
    """Name of the indenter on the arm."""
    faces: tuple[tuple[str, float], ...] = ()
    """Indenter and friction factor of each object that a finger presses, by its number."""
    truth: Path | None = None
    """File to log every state to, for tests."""
    host: str = "127.0.0.1"
    """Loopback address of the fault port."""
    fault_port: int | None = None
    """Port for the hand of an operator, see `rig.mock.world.host`; None: none."""

    def __post_init__(self) -> None:
        require_loopback(self.host)

    def surface(self, points: np.ndarray) -> Callable[[np.void], np.ndarray]:
        """Return a function of a WORLD_STATE: how points (n, 2) [m] move (n, 3) [m]."""
        if self.world.tier == "layer":
            return SimulatedSurface(self.world, self.folder, points)
        return LadderSurface(self.world, self.indenter, points, self.faces)


def build_world(settings: WorldConfig) -> World:
    """Build the World of these settings."""
    if settings.world.tier == "layer":
        return SimulatedWorld(settings.world, settings.contact_frame, settings.folder)
    return LadderWorld(settings.world, settings.indenter, settings.contact_frame)


def load_view(path: Path, kind: str = "camera") -> Callable[[np.void], np.ndarray]:
    """Return a function of a WORLD_STATE: the reading of a World's camera, or taxels, by `kind`.

    It returns RGB (480, 640, 3) uint8, or raw counts (taxels, 3) before noise. The World is that of
    a JSON document.

    Raises:
        ConfigError: The document is invalid, or the World has no such sensor.
    """
    settings = build(WorldConfig, read_yaml(path), str(path))
    if kind == "taxels" and settings.world.tier == "layer":
        return _counts(settings)
    reading = reading_of(settings.world, kind)
    surface = settings.surface(reading.points)
    return lambda state: reading.read(surface(state), int(state["t_ns"]))


def _counts(settings: WorldConfig) -> Callable[[np.void], np.ndarray]:
    pad_of(settings.world)
    solution = Between(settings.world, settings.folder)
    return lambda state: np.clip(
        solution.at(int(state["t_ns"]), tip_of(state))[6:], 0, 65535
    ).reshape(-1, 3)
