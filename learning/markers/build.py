"""Conversion of sessions to a marker archive: `tactile markers`."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from learning.indenters import UNSEEN
from learning.markers.efficient_sam import EfficientSam
from learning.markers.frames import FLAG, INVALID, RecordedSensor, one_thread
from learning.markers.recording import Recording, read_group
from recorder.archive import MASKS, MarkerArchive, fill_archive

# Maximum number of frames, and of reasons, that are listed individually.
NAMED = 5


def archive_sessions(
    sessions: Sequence[Path],
    out: Path,
    *,
    preset_name: str | None = None,
    sensor: str | None = None,
    finger: str | None = None,
    mm_per_px: float | None = None,
    unseen: tuple[str, ...] = UNSEEN,
    sam: EfficientSam | None = None,
    irregular: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[int, tuple[str, ...]]:
    """Make or resume the marker archive of sessions, one for each indenter on each sensor.

    Returns the number of frames made by this call, and lines of summary: frames, flags, omissions.
    The preset of marker detection, by default that of each sensor, the name of the sensor, and the
    size of a pixel [mm] replace those of sessions and preset. Of sessions of a hand, one `finger`
    is read. `unseen` are indenters that models may not be trained on; `sam` refines masks of
    pictures; `irregular` markers have no regular pattern, and are rejected otherwise. Progress is
    called with the frames made and the total.
    """
    one_thread()
    recordings, indenters = read_group(sessions, sensor, finger)
    sensors = [
        RecordedSensor(
            name,
            some,
            indenters,
            preset_name,
            mm_per_px=mm_per_px,
            unseen=unseen,
            sam=sam,
            irregular=irregular,
        )
        for name, some in recordings.items()
    ]
    attrs = {"made_from": "sessions"}
    frames = fill_archive(out, sensors, indenters, attrs, progress)
    omitted = (line for some in recordings.values() for one in some for line in _omitted(one))
    return frames, (*omitted, *summary(out))


def summary(path: Path) -> tuple[str, ...]:
    """Return lines that summarise an archive: frames, flags and missing frames of each sensor."""
    lines = []
    for name, sensor in MarkerArchive(path).items():
        lines_of_rows = sensor.provenance(slice(None))
        content = {line: json.loads(line) for line in set(lines_of_rows)}
        sources = [content[line] for line in lines_of_rows]
        flagged = [row for row, source in enumerate(sources) if FLAG in source]
        invalid = Counter(source[INVALID] for source in sources if INVALID in source)
        text = f"{name}: {len(sensor):,} frames, {len(sensor.reference_frames)} references"
        if sensor.attrs["marker_check"] is None:
            text += (
                "; markers are not counted"
                if sensor.representation == MASKS
                else f"; {sensor.representation.name}: train with --preset shading"
            )
        else:
            fraction = len(flagged) / max(len(sensor), 1)
            text += f"; marker count: {len(flagged)} flagged ({100 * fraction:.2f} %)"
        lines.append(text)
        lines += [f"  {view}"] if (view := sensor.attrs.get("view")) else []
        lines += [f"  row {row}: {sources[row][FLAG]}" for row in flagged[:NAMED]]
        if len(flagged) > NAMED:
            lines.append(f"  and {len(flagged) - NAMED} more: {FLAG} in their sources")
        lines += [f"  {count} frames are not there: {why}" for why, count in invalid.most_common()]
    return tuple(lines)


def _omitted(recording: Recording) -> Iterator[str]:
    yield from (f"{recording.name}: {text}" for text in recording.omitted[:NAMED])
    if (more := len(recording.omitted) - NAMED) > 0:
        yield f"{recording.name}: and {more} more of the kind"
