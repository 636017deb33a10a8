"""Contact sheet of an archive made from sessions: outlines of the markers over the pictures."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.contact_sheet import marker_picture, write_sheet
from learning.errors import LearningError
from learning.markers.frames import FLAG
from learning.markers.recording import Recording
from learning.markers.segment import (
    CameraPreset,
    Picture,
    change_of,
    outlined,
    picture_of,
    preset,
    view_of,
)
from recorder import MarkerArchive
from recorder.archive import MASKS, ArchivedSensor
from recorder.markers import SMALLEST_PX, count_markers, unpack
from recorder.plot import Tile
from recorder.spec import PHASES

# Maximum number of frames of a session next to its reference, and of flagged ones among them.
SHEET_FRAMES, FLAGGED = 5, 2
OUTLINE = (255, 150, 30)


def draw_sheet(path: Path, sensors: Mapping[str, Sequence[Recording]], out: Path) -> None:
    """Write a PNG with a row for each session: reference, even frames, and flagged ones in red."""
    archive = MarkerArchive(path)
    rows = []
    for name, recordings in sensors.items():
        if name not in archive:
            raise LearningError(f"{path}: has no sensor {name}")
        first, archived = 0, archive[name]
        for recording in recordings:
            of = range(first, first := first + len(recording))
            if first > len(archived):
                raise LearningError(
                    f"{name}: has {len(archived)} frames, its sessions have {first} or more"
                )
            flagged = [row for row in of if FLAG in json.loads(archived.provenance([row])[0])]
            note = f"{recording.name}   {len(of):,} frames, {len(flagged)} flagged"
            chosen = _chosen(archived, of, flagged)
            if archived.representation != MASKS:
                tiles = [_shading(archived, row) for row in chosen]
            else:
                tiles = _masks(archived, recording, of.start, chosen, flagged)
            rows.append((f"{name}, {recording.indenter}", note, tiles))
    write_sheet(rows, out, 1 + SHEET_FRAMES)


def _masks(
    archived: ArchivedSensor,
    recording: Recording,
    first: int,
    chosen: Sequence[int],
    flagged: Sequence[int],
) -> list[Tile]:
    """Return the reference and some rows of a recording, with the outlines of their markers."""
    mask = unpack(archived.references[int(archived.table["reference"][first])])
    pixels = _outlined(archived, recording, recording.reference_images()[0], mask)
    tiles = [Tile(pixels, (f"reference: {_count(archived, mask)}", "no contact"))]
    images = recording.column(recording.shown)
    for row in chosen:
        (mask,) = archived.masks([row])
        pixels = _outlined(archived, recording, int(images[row - first]), mask)
        tiles.append(Tile(pixels, _caption(archived, row, mask), row in flagged))
    return tiles


def _shading(archived: ArchivedSensor, row: int) -> Tile:
    """Return the shading of a row, its changes enlarged."""
    (shading,) = archived.frames([row])
    force = archived.table["wrench"][row, 2]
    measured = f"Fz {force:+.2f} N" if np.isfinite(force) else "no force"
    upper = f"row {row}, target {archived.table['target'][row]}"
    lower = f"mean change {change_of(shading):.1f} grey levels, {measured}"
    return Tile(picture_of(shading), (upper, lower))


def _chosen(archived: ArchivedSensor, of: range, flagged: list[int]) -> list[int]:
    """Return the rows to show: the deepest of some targets, then flagged ones."""
    table = archived.table
    valid = np.array([row for row in of if table["valid"][row]])
    sampled = flagged[:: max(len(flagged) // FLAGGED, 1)][:FLAGGED]
    if not valid.size:
        return sampled
    target = table["target"][valid]
    deepest = [
        int(some[np.argmax(table["depth"][some] + 1e-9 * table["phase"][some])])
        for some in (valid[target == one] for one in np.unique(target))
    ]
    room = min(SHEET_FRAMES - len(sampled), len(deepest))
    evenly = np.linspace(0, len(deepest) - 1, room).round().astype(int)
    return [*(deepest[index] for index in evenly), *sampled]


def _outlined(
    archived: ArchivedSensor, recording: Recording, image: int, mask: NDArray[np.bool_]
) -> Picture:
    """Return the picture (480, 640, 3) as the detection gets it; the mask alone for taxels."""
    settings = preset(str(archived.attrs["preset"]))
    if not isinstance(settings, CameraPreset):
        return marker_picture(mask)
    return outlined(view_of(recording.picture(image), settings.region), mask, OUTLINE, 2)


def _count(archived: ArchivedSensor, mask: NDArray[np.bool_]) -> str:
    smallest = (archived.attrs.get("marker_check") or {}).get("smallest_px", SMALLEST_PX)
    return f"{count_markers(mask, smallest)} markers"


def _caption(archived: ArchivedSensor, row: int, mask: NDArray[np.bool_]) -> tuple[str, str]:
    table = archived.table
    code = int(table["phase"][row])
    phase = PHASES[code].replace("_", " ") if code >= 0 else "no phase"
    force = table["wrench"][row]
    forces = "no force"
    if np.isfinite(force[:3]).any():
        axes = (f"{axis:+.2f}" if np.isfinite(axis) else "-" for axis in force[:3])
        forces = f"F {' '.join(axes)} N"
    upper = f"row {row}, target {table['target'][row]}, {phase}: {_count(archived, mask)}"
    return upper, f"{1e3 * table['depth'][row]:.2f} mm, {forces}"
