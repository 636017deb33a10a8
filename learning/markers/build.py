"""Conversion of sessions to a marker archive, with its speed and a contact sheet."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from learning.archive_writer import FLAG, INVALID, fill_archive
from learning.errors import LearningError
from learning.indenters import UNSEEN
from learning.markers.efficient_sam import EfficientSam
from learning.markers.frames import RecordedSensor, one_thread, taxel_masks
from learning.markers.recording import Group, Placed, Recording, SensorGroup, read_group
from learning.markers.segment import (
    CameraPreset,
    Segmenter,
    ShadingPreset,
    TaxelPreset,
    find_centres,
    grey,
    names,
    outlined,
    preset,
    preset_of_sensor,
)
from learning.markers.shading import cells_of, change_of, picture_of
from recorder import MarkerArchive
from recorder.archive import MASKS, ArchivedSensor
from recorder.markers import SMALLEST_PX, count_markers, pack, unpack
from recorder.plot import INK, PAPER, SOFT, font
from recorder.spec import PHASES

# Implementation of `tactile markers`.

# Maximum number of frames, and of reasons, that are listed individually.
NAMED = 5


@dataclass(frozen=True, slots=True)
class Built:
    """Result of building an archive."""

    path: Path
    made: int
    """Number of frames made by this call."""
    lines: tuple[str, ...]
    """Summary: frames, flags, omissions."""


def archive_sessions(
    sessions: Sequence[Path],
    out: Path,
    *,
    preset_name: str | None = None,
    sensor: str | None = None,
    mm_per_px: float | None = None,
    unseen: tuple[str, ...] = UNSEEN,
    sam: EfficientSam | None = None,
    irregular: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Built:
    """Make or resume the marker archive of sessions.

    Args:
        sessions: One for each indenter on each sensor.
        out: The archive.
        preset_name: Preset of marker detection for all sensors; None: the preset for each.
        sensor: Name of the sensor, instead of the names in the sessions.
        mm_per_px: Size of a pixel [mm], instead of the preset's.
        unseen: Indenters that models may not be trained on.
        sam: Model that refines masks of pictures; None: no refinement.
        irregular: True for markers without a regular pattern, which are rejected otherwise.
        progress: Called with the number of frames that exist and the total.

    Raises:
        LearningError: Sessions are incompatible, or a preset does not fit.
        SessionError: A session is corrupt, or another archive exists at `out`.
        OSError: The disk is full, or not writable.
    """
    one_thread()
    group = read_group(sessions, sensor)
    sensors = [
        recorded_sensor(
            one,
            group,
            preset_name=preset_name,
            mm_per_px=mm_per_px,
            unseen=unseen,
            sam=sam,
            irregular=irregular,
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
    irregular: bool = False,
) -> RecordedSensor:
    """Return a sensor of a group with the given preset, or the one for its name.

    Raises:
        LearningError: There is no preset for it, or the preset does not fit.
    """
    chosen = preset_name or preset_of_sensor(one.name)
    if chosen is None:
        raise LearningError(
            f"{one.name}: no preset is assigned to it; allowed: {', '.join(names())}, or a .yaml "
            "file"
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
        irregular=irregular,
    )


def told(path: Path) -> tuple[str, ...]:
    """Return lines that summarise an archive: frames, flags and missing frames of each sensor.

    Raises:
        SessionError: There is no archive, or it is corrupt.
    """
    lines = []
    for name, sensor in MarkerArchive(path).items():
        of = sensor.table["source"]
        reported = [json.loads(line) for line in sensor.sources]
        flagged = [row for row, one in enumerate(of) if FLAG in reported[one]]
        invalid = Counter(reported[one][INVALID] for one in of if INVALID in reported[one])
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
        lines += [f"  row {row}: {reported[of[row]][FLAG]}" for row in flagged[:NAMED]]
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
            reported = placed.recording.omitted
            lines += [f"{placed.recording.name}: {text}" for text in reported[:NAMED]]
            if len(reported) > NAMED:
                lines.append(
                    f"{placed.recording.name}: and {len(reported) - NAMED} more of the kind"
                )
    return tuple(lines)


# Number of timed frames and of repeats; the fastest repeat counts.
FRAMES, REPEATS = 100, 3
# A step that archives do not need; it is reported but not in the sum.
CENTRES = "centres"


def rates(
    sessions: list[Path],
    *,
    preset_name: str | None = None,
    sensor: str | None = None,
    sam: EfficientSam | None = None,
) -> Iterator[str]:
    """Yield a line for each sensor: frames per second in total, and for each step.

    Raises:
        LearningError: Sessions are incompatible, or a preset does not fit.
        SessionError: A session is corrupt.
    """
    one_thread()
    group = read_group(sessions, sensor)
    for one in group.sensors:
        made = recorded_sensor(one, group, preset_name=preset_name, mm_per_px=1.0)
        recording = one.placed[0].recording
        found = made.preset
        if isinstance(found, CameraPreset):
            steps = _camera(recording, found, sam)
        elif isinstance(found, ShadingPreset):
            rows = np.unique(recording.column("image"))
            rows = rows[rows >= 0][:FRAMES]
            pictures, no_contact = recording.camera.images(rows), found
            steps = {
                "reading": _fastest(lambda: recording.camera.images(rows), len(rows)),  # noqa: B023
                "shading": _fastest(
                    lambda: [cells_of(picture, no_contact) for picture in pictures],  # noqa: B023
                    len(rows),
                ),
            }
        else:
            steps = _taxels(recording, found)
        total = sum(seconds for name, seconds in steps.items() if name != CENTRES)
        parts = ", ".join(f"{name} {1 / seconds:,.0f}" for name, seconds in steps.items())
        yield f"{one.name}: {1 / total:,.0f} frames/s of one core ({parts})"


def _camera(
    recording: Recording, preset: CameraPreset, sam: EfficientSam | None
) -> dict[str, float]:
    """Return the seconds per frame of each step."""
    camera = recording.camera
    rows = np.unique(recording.column("image"))
    rows = rows[rows >= 0][:FRAMES]
    if not rows.size:
        raise LearningError(f"{recording.name}: has no pictures of a press")
    segmenter = Segmenter(preset)
    pictures = camera.images(rows)
    views = [segmenter.view(picture) for picture in pictures]
    masks = [segmenter.mask_of_view(view) for view in views]
    steps = {
        "reading": _fastest(lambda: camera.images(rows), len(rows)),
        "mask": _fastest(lambda: [segmenter.mask(picture) for picture in pictures], len(rows)),
        "packing": _fastest(lambda: [pack(mask) for mask in masks], len(rows)),
    }
    if sam is not None:
        some = range(min(len(rows), 5))
        steps["EfficientSAM"] = _fastest(
            lambda: [sam.refined(views[one], masks[one], preset.box_px) for one in some], len(some)
        )
    steps[CENTRES] = _fastest(
        lambda: [find_centres(mask, grey(view)) for mask, view in zip(masks, views, strict=True)],
        len(rows),
    )
    return steps


def _taxels(recording: Recording, preset: TaxelPreset) -> dict[str, float]:
    counts = recording.column("taxels")[:FRAMES]
    no_contact = recording.session.reference["taxels"][recording.references[0]]
    masks = taxel_masks(counts, no_contact, preset)
    return {
        "mask": _fastest(lambda: taxel_masks(counts, no_contact, preset), len(counts)),
        "packing": _fastest(lambda: pack(masks), len(counts)),
    }


def _fastest(work: Callable[[], object], frames: int) -> float:
    """Return the CPU time per frame [s], the minimum of the repeats."""
    spent = []
    for _ in range(REPEATS):
        began = time.process_time()
        work()
        spent.append(time.process_time() - began)
    return max(min(spent), 1e-9) / frames


# Contact sheet of an archive made from sessions: outlines of the markers over the pictures.

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

    Raises:
        LearningError: The archive was not made from these sessions.
        SessionError: The archive or a session is corrupt.
        OSError: The file is not writable.
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
    view = _view(archived, placed, int(_reference_image(placed)))
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


def _reference_image(placed: Placed) -> int:
    recording = placed.recording
    return int(recording.session.reference["image"][recording.references[0]])


def _image_of(placed: Placed, row: int) -> int:
    return int(placed.recording.column("image")[row])


def _view(archived: ArchivedSensor, placed: Placed, image: int) -> NDArray[np.uint8] | None:
    """Return the picture (480, 640, 3) as input to the detection; None for taxels."""
    if placed.recording.kind != "camera":
        return None
    found = preset(str(archived.attrs["preset"]))
    if not isinstance(found, CameraPreset):
        raise LearningError(f"{archived.name}: preset {archived.attrs['preset']} is for taxels")
    (picture,) = placed.recording.camera.images([image])
    return Segmenter(found).view(picture)


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
