"""Presets in YAML: those that are shipped, by name, and files of one's own."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import get_args

from learning.markers.preset import Preset
from learning.settings import build_one_of, preset_names, preset_path, read_mapping

FOLDER = Path(__file__).parent / "presets"


@cache
def names() -> tuple[str, ...]:
    """Return the names of the presets that are shipped."""
    return preset_names(FOLDER)


def preset(name: str) -> Preset:
    """Return a preset by name, or from a YAML file if the name ends so.

    Raises:
        LearningError: No such preset, or a file that is none.
    """
    return read_preset(preset_path(FOLDER, name))


def preset_of_sensor(sensor: str) -> str | None:
    """Return the name of the preset that is meant for a sensor; None: there is none."""
    for name in names():
        if sensor in preset(name).sensors:
            return name
    return None


def read_preset(path: Path) -> Preset:
    """Return the preset in a YAML file.

    Raises:
        LearningError: Not there, not YAML, or a key or value that is not allowed.
    """
    made: Preset = build_one_of(get_args(Preset), read_mapping(path), str(path))
    return made
