"""World of the mock bench: turns the arm's motion into states that the emulators measure."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rig.bench.worlds import AnalyticSpec, SimulatedSpec
from rig.core.config import build
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
    "WorldFile",
    "build_world",
    "load_view",
    "read_file",
]

_SPECS: dict[str, type[AnalyticSpec] | type[SimulatedSpec]] = {
    spec.KIND: spec for spec in (AnalyticSpec, SimulatedSpec)
}


@dataclass(frozen=True, slots=True)
class WorldFile:
    """Settings that a mock bench passes to the processes of its World."""

    world: AnalyticSpec | SimulatedSpec
    contact_frame: tuple[float, ...]
    """Pose (6,) in the base frame [m, rad]."""
    indenter: str
    """Name of the indenter on the arm."""
    folder: Path
    """Run folder with the shared records."""


def read_file(path: Path) -> WorldFile:
    """Read the JSON file that a mock bench writes into its run folder.

    It holds `world` as in a bench file, `contact_frame` as a pose (6,) [m, rad] and `indenter`.

    Raises:
        ConfigError: A key is missing or invalid.
    """
    content = json.loads(path.read_text())
    if not isinstance(content, dict) or {"world", "contact_frame"} - content.keys():
        raise ConfigError(f"{path}: allowed: a JSON object with 'world' and 'contact_frame'")
    kind = content["world"].get("kind", AnalyticSpec.KIND)
    if kind not in _SPECS:
        raise ConfigError(f"{path}.world.kind: found {kind!r}; allowed: {sorted(_SPECS)}")
    return WorldFile(
        world=build(_SPECS[kind], content["world"], f"{path}.world"),
        contact_frame=tuple(float(value) for value in content["contact_frame"]),
        indenter=str(content.get("indenter", "")),
        folder=path.parent,
    )


def build_world(path: Path) -> World:
    """Build the World that the JSON file describes."""
    file = read_file(path)
    if isinstance(file.world, SimulatedSpec):
        return SimulatedWorld(file.world, file.contact_frame, file.folder)
    return AnalyticWorld(file.world, file.contact_frame)


def load_view(path: Path) -> Callable[[np.void], np.ndarray]:
    """Return a function that renders a WORLD_STATE as that World's camera: RGB (480, 640, 3) uint8.

    Raises:
        ConfigError: The World has no camera.
    """
    file = read_file(path)
    spec = file.world
    if isinstance(spec, SimulatedSpec):
        return SimulatedView(spec, file.folder)
    if spec.markers is None:
        raise ConfigError(f"{path}.world.markers: missing; allowed: a marker view")
    grey = 0.0 if spec.noise is None else spec.noise.grey
    camera = MarkerCamera(spec.markers, grey_noise=grey)
    return lambda state: camera.image(surface_of(spec, state))
