"""World of the mock bench: turns the arm's motion into states that the emulators measure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rig.bench.worlds import AnalyticSpec, SimulatedSpec
from rig.core.config import build, read_yaml
from rig.core.errors import ConfigError
from rig.mock.world.analytic import AnalyticWorld, World, surface_of
from rig.mock.world.picture import MarkerCamera
from rig.mock.world.simulated import SimulatedView, SimulatedWorld

__all__ = [
    "AnalyticSpec",
    "AnalyticWorld",
    "SimulatedSpec",
    "SimulatedWorld",
    "World",
    "WorldConfig",
    "build_world",
    "load_view",
]


@dataclass(frozen=True, slots=True)
class WorldConfig:
    """Settings of the processes of a World, and of its view."""

    world: AnalyticSpec | SimulatedSpec
    contact_frame: tuple[float, ...] = field(metadata={"pose": True})
    """Pose (6,) in the base frame [m, rad]."""
    folder: Path
    """Run folder with the shared records."""
    indenter: str = ""
    """Name of the indenter on the arm."""
    truth: Path | None = None
    """File to log every state to, for tests."""
    host: str = "127.0.0.1"
    """Loopback address of the fault port."""
    fault_port: int | None = None
    """Port for the hand of an operator, see `rig.mock.world.host`; None: none."""


def build_world(settings: WorldConfig) -> World:
    """Build the World of these settings."""
    if isinstance(settings.world, SimulatedSpec):
        return SimulatedWorld(settings.world, settings.contact_frame, settings.folder)
    return AnalyticWorld(settings.world, settings.contact_frame)


def load_view(path: Path) -> Callable[[np.void], np.ndarray]:
    """Return a function that renders a WORLD_STATE as a World's camera: RGB (480, 640, 3) uint8.

    Args:
        path: JSON document of the World.

    Raises:
        ConfigError: The document is invalid, or the World has no camera.
    """
    settings = build(WorldConfig, read_yaml(path), str(path))
    spec = settings.world
    if isinstance(spec, SimulatedSpec):
        return SimulatedView(spec, settings.folder)
    if spec.markers is None:
        raise ConfigError(f"{path}.world.markers: missing; allowed: a marker view")
    grey = 0.0 if spec.noise is None else spec.noise.grey
    camera = MarkerCamera(spec.markers, grey_noise=grey)
    return lambda state: camera.image(surface_of(spec, state))
