"""Settings of a field translator that trains in a second."""

from learning.config import read_settings
from learning.translation.field.network import FieldModel
from learning.translation.field.train import PRESETS, FieldSettings

TINY: dict[str, object] = {
    "net.widths": [8, 8, 8, 16],
    "map.widths": [8, 8, 16],
    "map.numbers": 4,
    "examples.patterns": 1,
}


def tiny(**changes: object) -> FieldSettings:
    sets = [f"{key}={value}" for key, value in (TINY | changes).items()]
    return read_settings(FieldSettings, PRESETS, "cpu_smoke", sets)


def untrained(settings: FieldSettings | None = None) -> FieldModel:
    settings = settings or tiny()
    return FieldModel(settings.net, settings.map, settings.seed)
