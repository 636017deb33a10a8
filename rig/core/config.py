"""Bench files: strict YAML into frozen dataclasses, as `recorder.settings` reads them."""

from recorder.settings import Reader, from_si, to_si
from rig.core.errors import ConfigError

READER = Reader(ConfigError)

build, read_yaml = READER.build, READER.read

__all__ = ["READER", "build", "from_si", "read_yaml", "to_si"]
