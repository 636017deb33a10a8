"""Conditions that a force model was made for, as its folder states, and how a sensor differs."""

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.force.intervals import read_intervals
from learning.markers.segment import (
    TaxelPreset,
    built_preset,
    kept_preset,
    preset,
    preset_of_sensor,
)
from learning.training.checkpoint import CONFIG, read_config
from recorder.archive import MASKS, ArchivedSensor, MarkerArchive
from recorder.markers import count_markers, unpack

# Keys of the metadata of a model's `config.yaml`: sensors, and how `tactile force` chose it.
KEY, CHOICE = "made_for", "choice"
# Markers and depth may differ by this fraction: some markers are missed, some presses end late.
TOLERANCE = 0.1


@dataclass(frozen=True, slots=True)
class Conditions:
    """A sensor and its presses: those that a model was made for, or those that it meets."""

    sensor: str
    signal: str = ""
    """`camera` or `taxels`; empty: unknown."""
    description: str = ""
    """The sensor in words."""
    depth: float = math.nan
    """Depth of the deepest press [m]; NaN: unknown."""
    markers: int = 0
    """Markers that are seen without contact; 0: none, or unknown."""

    def __str__(self) -> str:
        """Return the sensor with all that is known of it."""
        known = [self.description] if self.description else []
        known += [f"{self.markers} markers"] if self.markers else []
        known += [f"to {1e3 * self.depth:.2f} mm"] if self.depth == self.depth else []
        return f"{self.sensor} ({', '.join(known)})" if known else self.sensor


def of_archive(sensor: ArchivedSensor, rows: NDArray[np.int64]) -> dict[str, Any]:
    """Return a model's statement on a sensor in an archive and the rows that it learns."""
    masks = sensor.representation == MASKS
    depth = sensor.table["depth"][rows]
    pressed = bool((depth > 0).any())
    return {
        "description": str(sensor.attrs.get("description", "")),
        "markers": count_markers(unpack(sensor.references[0])) if masks else 0,
        "depth_mm": round(1e3 * float(np.nanmax(depth)), 3) if pressed else None,
    }


def metadata_of(archive: MarkerArchive, rows: Mapping[str, NDArray[np.int64]]) -> dict[str, Any]:
    """Return the metadata of a model of some sensors in an archive, by the rows that each learns.

    By its presets a live stream is read as the pictures were from which the model learned.
    """
    preset_of = {name: str(archive[name].attrs.get("preset", "")) for name in rows}
    presets = {
        name: stored for name, each in preset_of.items() if each and (stored := kept_preset(each))
    }
    return {
        "sensors": [*rows],
        **({"presets": presets} if presets else {}),
        KEY: {name: of_archive(archive[name], learned) for name, learned in rows.items()},
    }


def made_for(model: str | os.PathLike[str]) -> tuple[Conditions, ...]:
    """Return the purpose of the model in a folder, by sensor; empty if it is not stated.

    A model of `A-to-B` was made for B.
    """
    if not (Path(model) / CONFIG).is_file():
        return ()
    metadata = read_config(Path(model)).metadata
    known, presets = metadata.get(KEY, {}), metadata.get("presets", {})
    found = []
    for name in metadata.get("sensors", ()):
        sensor, one = str(name).rpartition("-to-")[2], known.get(name, {})
        chosen = presets.get(name) or preset_of_sensor(sensor)
        signal = ""
        if chosen:
            built = preset(chosen) if isinstance(chosen, str) else built_preset(chosen, str(model))
            signal = "taxels" if isinstance(built, TaxelPreset) else "camera"
        depth = one.get("depth_mm")
        description, markers = str(one.get("description", "")), int(one.get("markers", 0))
        meters = math.nan if depth is None else 1e-3 * float(depth)
        found.append(Conditions(sensor, signal, description, meters, markers))
    return tuple(found)


def origin_of(model: str | os.PathLike[str]) -> str:
    """Return the way by which `tactile force` made the model in a folder, and its intervals.

    Empty for another model.
    """
    folder = Path(model)
    metadata = read_config(folder).metadata if (folder / CONFIG).is_file() else {}
    choice = metadata.get(CHOICE, {})
    way = str(choice.get("about", ""))
    way += f", by labels of {choice['source']}" if choice.get("source") else ""
    intervals = read_intervals(folder)
    if not way or intervals is None:
        return way
    errors = [
        f"{axis} +- {error.base:.2f} N +- {100 * error.slope:.0f} %"
        for axis, error in zip(("Fx", "Fy", "Fz"), intervals.axes, strict=True)
        if error is not None
    ]
    scale = "; scale assumed" if intervals.scale.assumed else ""
    return f"{way}; 90 % intervals {', '.join(errors)}{scale}"


def differences(model: str, made: Sequence[Conditions], here: Conditions) -> Iterator[str]:
    """Yield how a sensor differs from those that a model was made for, both sides named.

    Another signal is an error, as its forces would mean nothing.
    """
    best = _nearest(made, here.sensor)
    if best is None:
        return
    if best.signal and here.signal and best.signal != here.signal:
        raise LearningError(
            f"model {model}: made for the {best.signal} of {best}; found the {here.signal} of "
            f"{here}; allowed: a model of {here.signal}"
        )
    if best.sensor != here.sensor:
        yield (
            f"model {model} was made for {best}, not for {here}: pattern and skin may differ, "
            "and its forces by an unknown factor"
        )
    elif here.depth > (1 + TOLERANCE) * best.depth:
        yield (
            f"model {model} was made for {best}; this bench presses to {1e3 * here.depth:.2f} mm: "
            "deeper presses are outside of what it learned"
        )


def other_pattern(model: str, made: Sequence[Conditions], sensor: str, markers: int) -> str:
    """Return how the number of markers differs from that of a model's sensor, or an empty text."""
    best = _nearest(made, sensor)
    if best is None or not best.markers or abs(markers / best.markers - 1) <= TOLERANCE:
        return ""
    return f"model {model} was made for {best}; {sensor} shows {markers} markers: another pattern"


def _nearest(made: Sequence[Conditions], sensor: str) -> Conditions | None:
    return next((one for one in made if one.sensor == sensor), made[0] if made else None)
