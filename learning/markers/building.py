"""The one call behind `python -m learning markers`: sessions in, an archive out."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from learning.errors import LearningError
from learning.filling import fill_archive
from learning.flags import FLAG, INVALID
from learning.indenters import UNSEEN
from learning.markers.catalogue import names, preset, preset_of_sensor
from learning.markers.efficient_sam import EfficientSam
from learning.markers.frames import RecordedSensor, one_thread
from learning.markers.group import Group, SensorGroup, read_group
from recorder import MarkerArchive

NAMED = 5
"""Frames, and reasons, that are told of one by one."""


@dataclass(frozen=True, slots=True)
class Built:
    """What became of an archive."""

    path: Path
    made: int
    """Frames that were made now; others were there."""
    lines: tuple[str, ...]
    """What there is to say of it: frames, flags, what was left out."""


def archive_sessions(
    sessions: Sequence[Path],
    out: Path,
    *,
    preset_name: str | None = None,
    sensor: str | None = None,
    mm_per_px: float | None = None,
    unseen: tuple[str, ...] = UNSEEN,
    sam: EfficientSam | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Built:
    """Make the marker archive of sessions, or go on with it.

    Args:
        sessions: One for each indenter on each sensor.
        out: The archive.
        preset_name: How markers are found, for all sensors; what is meant for each when None.
        sensor: What the sensor is called, in place of what the sessions say.
        mm_per_px: Size of a pixel [mm], in place of the preset's.
        unseen: Indenters that models may not be trained on.
        sam: Refines what presets find in pictures; None leaves it.
        progress: Called with the frames that are there and those there will be.

    Raises:
        LearningError: Sessions that do not belong together, or a preset that does not fit.
        SessionError: A damaged session, or another archive at `out`.
        OSError: The disk is full, or not writable.
    """
    one_thread()
    group = read_group(sessions, sensor)
    sensors = [
        recorded_sensor(
            one, group, preset_name=preset_name, mm_per_px=mm_per_px, unseen=unseen, sam=sam
        )
        for one in group.sensors
    ]
    attrs = {"made_from": "sessions"}
    made = fill_archive(out, sensors, group.indenters, attrs, progress)
    return Built(out, made, (*_left_out(group), *told(out)))


def recorded_sensor(
    one: SensorGroup,
    group: Group,
    *,
    preset_name: str | None = None,
    mm_per_px: float | None = None,
    unseen: tuple[str, ...] = UNSEEN,
    sam: EfficientSam | None = None,
) -> RecordedSensor:
    """Return a sensor of a group with the preset that is meant for it, or the one that is said.

    Raises:
        LearningError: No preset is meant for it, or one that does not fit.
    """
    chosen = preset_name or preset_of_sensor(one.name)
    if chosen is None:
        raise LearningError(
            f"{one.name}: no preset is meant for it; say one of {', '.join(names())}, or a .yaml "
            "file of your own"
        )
    found = preset(chosen)
    return RecordedSensor(
        one,
        group.indenters,
        found,
        preset_name=chosen,
        mm_per_px=mm_per_px,
        unseen=unseen,
        sam=sam if found.KIND == "camera" else None,
    )


def told(path: Path) -> tuple[str, ...]:
    """Return lines on an archive: frames a sensor, what was flagged, what is not there.

    Raises:
        SessionError: No archive, or a damaged one.
    """
    lines = []
    for name, sensor in MarkerArchive(path).items():
        of = sensor.table["source"]
        said = [json.loads(line) for line in sensor.sources]
        flagged = [row for row, one in enumerate(of) if FLAG in said[one]]
        invalid = Counter(said[one][INVALID] for one in of if INVALID in said[one])
        text = f"{name}: {len(sensor):,} frames, {len(sensor.references)} references"
        if sensor.attrs["marker_check"] is None:
            text += "; markers are not counted"
        else:
            share = len(flagged) / max(len(sensor), 1)
            text += f"; marker count: {len(flagged)} flagged ({100 * share:.2f} %)"
        lines.append(text)
        lines += [f"  row {row}: {said[of[row]][FLAG]}" for row in flagged[:NAMED]]
        if len(flagged) > NAMED:
            lines.append(f"  and {len(flagged) - NAMED} more: {FLAG} in their sources")
        lines += [f"  {count} frames are not there: {why}" for why, count in _sorted(invalid)]
    return tuple(lines)


def _sorted(reasons: Mapping[str, int]) -> list[tuple[str, int]]:
    return sorted(reasons.items(), key=lambda one: -one[1])


def _left_out(group: Group) -> tuple[str, ...]:
    lines = []
    for sensor in group.sensors:
        for placed in sensor.placed:
            said = placed.recording.left_out
            lines += [f"{placed.recording.name}: {text}" for text in said[:NAMED]]
            if len(said) > NAMED:
                lines.append(f"{placed.recording.name}: and {len(said) - NAMED} more of the kind")
    return tuple(lines)
