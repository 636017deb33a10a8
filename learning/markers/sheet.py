"""Contact sheet of an archive made from sessions: outlines of the markers over the pictures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from learning.errors import LearningError
from learning.markers.flags import FLAG
from learning.markers.recording import Group, Placed, SensorGroup
from learning.markers.segment import CameraPreset, Segmenter, outlined, preset
from learning.markers.shading import change_of, picture_of
from recorder import MarkerArchive
from recorder.archive import MASKS, ArchivedSensor
from recorder.markers import SMALLEST_PX, count_markers, unpack
from recorder.plot import INK, PAPER, SOFT, font
from recorder.spec import PHASES

# Size of a picture, space around it, height of the captions below and above [px].
TILE, GAP, CAPTION, HEAD = (320, 240), 10, 40, 34
# Maximum number of frames of a session next to its reference, and of flagged ones among them.
SHEET_FRAMES, FLAGGED = 5, 2
OUTLINE, MARKER, GROUND, ALARM = (255, 150, 30), (240, 240, 236), (22, 26, 34), (220, 60, 50)
COLOURS = 256


def draw_sheet(archive_path: Path, group: Group, out: Path) -> None:
    """Write a PNG with a row for each session: its reference, then evenly spaced frames.

    Flagged frames, if any, come last, with a red frame.

    Args:
        archive_path: The archive.
        group: The sessions that it was made from.
        out: File to write.
    """
    archive = MarkerArchive(archive_path)
    rows = [(sensor, placed) for sensor in group.sensors for placed in sensor.placed]
    width = GAP + (1 + SHEET_FRAMES) * (TILE[0] + GAP)
    height = HEAD + TILE[1] + CAPTION + GAP
    page = Image.new("RGB", (width, GAP + len(rows) * height), PAPER)
    for place, (sensor, placed) in enumerate(rows):
        if sensor.name not in archive:
            raise LearningError(f"{archive_path}: has no sensor {sensor.name}")
        _draw_row(page, GAP + place * height, archive[sensor.name], sensor, placed)
    out.parent.mkdir(parents=True, exist_ok=True)
    page.quantize(COLOURS, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)


def _draw_row(
    page: Image.Image, top: int, archived: ArchivedSensor, sensor: SensorGroup, placed: Placed
) -> None:
    pen = ImageDraw.Draw(page)
    recording = placed.recording
    of = _rows_of(archived, sensor, placed)
    flagged = [row for row in of if FLAG in _said(archived, row)]
    title = f"{sensor.name}, {recording.indenter}"
    pen.text((GAP, top + 4), title, INK, font(17))
    text = f"{recording.name}   {len(of):,} frames, {len(flagged)} flagged"
    pen.text((GAP + 20 + pen.textlength(title, font(17)), top + 6), text, SOFT, font(14))
    chosen = _chosen(archived, of, flagged)
    if archived.representation != MASKS:
        _draw_shading(page, top, archived, chosen)
        return
    first = int(archived.table["reference"][of[0]])
    view = _view(archived, placed, placed.recording.reference_images()[0])
    mask = unpack(archived.references[first])
    tiles = [(_outlined(view, mask), f"reference: {_count(archived, mask)}", "no contact", False)]
    for row in chosen:
        (mask,) = archived.masks([row])
        picture = _outlined(_view(archived, placed, _image_of(placed, row - of[0])), mask)
        tiles.append((picture, *_caption(archived, row, mask), row in flagged))
    for place, (pixels, upper, lower, alarm) in enumerate(tiles):
        left = GAP + place * (TILE[0] + GAP)
        tile = Image.fromarray(pixels).resize(TILE, Image.Resampling.LANCZOS)
        page.paste(tile, (left, top + HEAD))
        if alarm:
            box = (left, top + HEAD, left + TILE[0] - 1, top + HEAD + TILE[1] - 1)
            pen.rectangle(box, outline=ALARM, width=3)
        pen.text((left, top + HEAD + TILE[1] + 4), upper, ALARM if alarm else INK, font(13))
        pen.text((left, top + HEAD + TILE[1] + 20), lower, SOFT, font(13))


def _draw_shading(page: Image.Image, top: int, archived: ArchivedSensor, chosen: list[int]) -> None:
    """Draw the shading of some rows, its changes enlarged."""
    pen = ImageDraw.Draw(page)
    for place, row in enumerate(chosen):
        (shading,) = archived.frames([row])
        left = GAP + place * (TILE[0] + GAP)
        tile = Image.fromarray(picture_of(shading)).resize(TILE, Image.Resampling.LANCZOS)
        page.paste(tile, (left, top + HEAD))
        force = archived.table["wrench"][row, 2]
        told = f"Fz {force:+.2f} N" if np.isfinite(force) else "no force"
        upper = f"row {row}, target {archived.table['target'][row]}"
        lower = f"mean change {change_of(shading):.1f} grey levels, {told}"
        pen.text((left, top + HEAD + TILE[1] + 4), upper, INK, font(13))
        pen.text((left, top + HEAD + TILE[1] + 20), lower, SOFT, font(13))


def _rows_of(archived: ArchivedSensor, sensor: SensorGroup, placed: Placed) -> range:
    first = 0
    for other in sensor.placed:
        if other is placed:
            break
        first += len(other.recording)
    rows = range(first, first + len(placed.recording))
    if rows.stop > len(archived):
        raise LearningError(
            f"{archived.name}: has {len(archived)} frames, its sessions have {rows.stop} or more"
        )
    return rows


def _chosen(archived: ArchivedSensor, of: range, flagged: list[int]) -> list[int]:
    """Return the rows to show: the deepest of some targets, then flagged ones."""
    table = archived.table
    valid = np.array([row for row in of if table["valid"][row]])
    shown = flagged[:: max(len(flagged) // FLAGGED, 1)][:FLAGGED]
    if not valid.size:
        return shown
    target = table["target"][valid]
    deepest = [
        int(some[np.argmax(table["depth"][some] + 1e-9 * table["phase"][some])])
        for some in (valid[target == one] for one in np.unique(target))
    ]
    room = min(SHEET_FRAMES - len(shown), len(deepest))
    evenly = np.linspace(0, len(deepest) - 1, room).round().astype(int)
    return [*(deepest[place] for place in evenly), *shown]


def _said(archived: ArchivedSensor, row: int) -> dict[str, object]:
    reported: dict[str, object] = json.loads(archived.sources[int(archived.table["source"][row])])
    return reported


def _image_of(placed: Placed, row: int) -> int:
    return int(placed.recording.column("image")[row])


def _view(archived: ArchivedSensor, placed: Placed, image: int) -> NDArray[np.uint8] | None:
    """Return the picture (480, 640, 3) as input to the detection; None for taxels."""
    if placed.recording.kind != "camera":
        return None
    found = preset(str(archived.attrs["preset"]))
    if not isinstance(found, CameraPreset):
        raise LearningError(f"{archived.name}: preset {archived.attrs['preset']} is for taxels")
    return Segmenter(found).view(placed.recording.picture(image))


def _outlined(view: NDArray[np.uint8] | None, mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    if view is None:
        return np.where(mask[..., None], MARKER, GROUND).astype(np.uint8)
    return outlined(view, mask, OUTLINE, 2)


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
