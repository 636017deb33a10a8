"""What the mock bench's sensors see: a World answers for the arm's motion, emulators serve it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rig.config import build
from rig.errors import ConfigError
from rig.world.analytic import AnalyticSpec, AnalyticWorld, World, surface_of
from rig.world.markers import MarkerCamera

__all__ = [
    "AnalyticSpec",
    "AnalyticWorld",
    "World",
    "build_world",
    "load_view",
    "read_spec",
]


def read_spec(path: Path) -> tuple[AnalyticSpec, tuple[float, ...]]:
    """The World's spec and the contact frame from the JSON file a mock bench writes.

    The file holds `world` as in a bench file and `contact_frame` as a pose (6,) [m, rad].

    Raises:
        ConfigError: A file that does not hold them.
    """
    content = json.loads(path.read_text())
    if not isinstance(content, dict) or {"world", "contact_frame"} - content.keys():
        raise ConfigError(f"{path}: allowed: a JSON object with 'world' and 'contact_frame'")
    spec = build(AnalyticSpec, content["world"], f"{path}.world")
    return spec, tuple(float(value) for value in content["contact_frame"])


def build_world(path: Path) -> World:
    """The World that the JSON file describes."""
    return AnalyticWorld(*read_spec(path))


def load_view(path: Path) -> Callable[[np.void], np.ndarray]:
    """How the camera of that World draws a WORLD_STATE: RGB (480, 640, 3) uint8.

    Raises:
        ConfigError: The World has no camera.
    """
    spec, _ = read_spec(path)
    if spec.markers is None:
        raise ConfigError(f"{path}.world.markers: missing; allowed: a marker view")
    grey = 0.0 if spec.noise is None else spec.noise.grey
    camera = MarkerCamera(spec.markers, grey_noise=grey)
    return lambda state: camera.image(surface_of(spec, state))
