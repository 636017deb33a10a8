"""The sensors that come with the simulator, by name, and sensors from files of one's own."""

from __future__ import annotations

from pathlib import Path

from sim.errors import SceneError
from sim.sensors.reading import build, read_mapping
from sim.sensors.sensor import SimulatedSensor

ROWS = Path(__file__).parent / "rows"
"""A file a sensor; its name is the sensor's."""

NAMES: tuple[str, ...] = tuple(sorted(path.stem for path in ROWS.glob("*.yaml")))
"""The names that `sensor` knows."""

HOMOGENEOUS = ("array-i", "array-ii", "circle-i", "circle-ii", "diamond-i")
"""The paper's five GelSights of one material and different markers."""
MATERIAL = ("r6", "r8", "r10", "r12", "r14", "r16", "r18")
"""Its seven skins of different hardness, from hard to soft."""
HETEROGENEOUS = ("uskin", "gelsight", "tacpalm")
"""Its three kinds of sensors, from hard to soft."""


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
