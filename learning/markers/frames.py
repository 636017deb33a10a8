"""Frames of one sensor's sessions, computed from pictures or taxels on demand, and their flags."""

import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.indenters import UNSEEN
from learning.markers.efficient_sam import EfficientSam
from learning.markers.pattern import ReferenceMarkers, spread_of, with_reference
from learning.markers.recording import Recording
from learning.markers.segment import (
    CameraPreset,
    Picture,
    Segmenter,
    ShadingPreset,
    TaxelPreset,
    cells_of,
    names,
    preset,
    preset_of_sensor,
    shading_of,
    shown_part,
)
from recorder.archive import CHUNK_ROWS, MASKS, SHADING, UNIT_ROWS, Frames, MarkerCount, SensorPlan
from recorder.markers import MarkerCheck, count_markers, draw_discs, find_blobs, pack, unpack

# Keys in the provenance of a frame: result of the marker count, and reason for a missing frame.
FLAG, INVALID = "marker_flag", "invalid"


def marker_flags(
    name: str,
    packed: NDArray[np.uint8],
    table: Mapping[str, NDArray[Any]],
    references: NDArray[np.uint8],
    count: MarkerCount | None,
) -> dict[int, str]:
    """Return a description of each of a sensor's frames whose markers are wrong, by row.

    Frames (n, 38400) and references without contact (K, 38400) are packed masks; `table` has their
    columns `reference` and `valid`. Without `count`, markers are not counted.
    """
    flags: dict[int, str] = {}
    if count is None:
        return flags
    for number in np.unique(table["reference"][table["valid"]]).tolist():
        reference = unpack(references[number])
        if not count_markers(reference, count.smallest_px):
            raise LearningError(
                f"{name}: reference {number} has no marker of {count.smallest_px} px or more"
            )
        check = MarkerCheck(reference, smallest_px=count.smallest_px, tolerance=count.tolerance)
        rows = np.flatnonzero(table["valid"] & (table["reference"] == number))
        for flag in check.flags(unpack(packed[rows])):
            text = f"{flag.found} markers, reference {flag.expected}: {flag.reason}"
            flags[int(rows[flag.row])] = text
    return flags


# Marker images of taxels: counts minus those without contact, drawn as discs.

_SIDE = 4


def taxel_masks(
    counts: NDArray[np.floating | np.integer],
    no_contact: NDArray[np.floating | np.integer],
    preset: TaxelPreset,
) -> NDArray[np.bool_]:
    """Draw the masks (n, 480, 640) of counts in the device's order (n, 16, 3) [counts].

    Counts without contact are one set (16, 3), or one for each frame.
    """
    change = np.asarray(counts, np.float64) - np.asarray(no_contact, np.float64)
    if preset.rows_from_top:
        rows = change.reshape(*change.shape[:-2], _SIDE, _SIDE, 3)
        change = (rows[..., ::-1, :, :] * [1.0, -1.0, 1.0]).reshape(change.shape)
    return draw_discs(change, preset.discs)


# Depths and positions that nobody knows; `archive join` refuses them.
UNKNOWN = "unknown: 0"

Integers = NDArray[np.int64]
Stored = NDArray[np.uint8]


# What a preset makes of the rows of recordings: stored references, and frames.


class _Markers:
    """Pictures of a gel with markers, as packed masks."""

    device, representation, one_reference = "camera", MASKS, False

    def __init__(
        self, preset: CameraPreset, name: str, sam: EfficientSam | None, irregular: bool
    ) -> None:
        self._preset, self._name, self._sam, self._irregular = preset, name, sam, irregular
        self._segmenter = Segmenter(preset)
        self._finders: dict[tuple[str, int], Segmenter | ReferenceMarkers] = {}
        self.count = MarkerCount(preset.area_px[0], preset.tolerance)
        self.attrs = {} if sam is None else {"efficient_sam": sam.identity}

    def references(self, recording: Recording) -> Stored:
        """Return the references of a recording (k, 38400)."""
        masks = []
        for image in recording.reference_images():
            mask = self._mask(self._view(recording, image), self._segmenter)
            blobs = find_blobs(mask[None], self._preset.area_px[0])
            if not len(blobs):
                raise LearningError(
                    f"{recording.name}: preset {self._name} finds no markers in its "
                    f"reference, image {image}; allowed: another preset, or --preset shading "
                    "for a gel without markers"
                )
            spread = spread_of(blobs.area[blobs.whole], blobs.centre[blobs.whole])
            if not (self._irregular or spread.is_regular):
                raise LearningError(
                    f"{recording.name}: preset {self._name} finds no pattern of "
                    f"markers in its reference, image {image}: {spread}; allowed: --preset "
                    "shading for a gel without markers, another preset (tactile markers-fit "
                    "fits one), or --irregular if the markers have no pattern"
                )
            masks.append(mask)
        return pack(np.stack(masks))

    def frames(self, recording: Recording, rows: Integers) -> Stored:
        """Return some rows of a recording (n, 38400); each picture is processed once."""
        images, first, inverse = np.unique(
            recording.column(recording.shown)[rows], return_index=True, return_inverse=True
        )
        masks = []
        for image, reference in zip(images, recording.reference[rows[first]], strict=True):
            finder = self._finder(recording, int(reference))
            masks.append(self._mask(self._view(recording, int(image)), finder))
        return pack(np.stack(masks))[inverse.reshape(-1)]

    def _view(self, recording: Recording, image: int) -> Picture:
        return self._segmenter.view(recording.picture(image))

    def _mask(self, view: Picture, finder: Segmenter | ReferenceMarkers) -> NDArray[np.bool_]:
        mask = finder.mask_of_view(view)
        return mask if self._sam is None else self._sam.refined(view, mask, self._preset.box_px)

    def _finder(self, recording: Recording, reference: int) -> Segmenter | ReferenceMarkers:
        """Return what makes the masks of pictures of one reference; the last one is kept."""
        key = recording.name, reference
        if key not in self._finders:
            view = self._view(recording, recording.reference_images()[reference])
            self._finders = {key: with_reference(self._segmenter, view)}
        return self._finders[key]


class _Taxels:
    """Counts of taxels, drawn as packed masks; one reference holds for all recordings."""

    device, representation, one_reference = "taxels", MASKS, True
    count = None
    attrs: Mapping[str, Any] = {}

    def __init__(self, preset: TaxelPreset) -> None:
        self._preset = preset

    def references(self, recording: Recording) -> Stored:
        return pack(taxel_masks(np.zeros((1, 16, 3)), np.zeros((16, 3)), self._preset))

    def frames(self, recording: Recording, rows: Integers) -> Stored:
        no_contact = recording.session.reference[recording.shown][recording.references]
        counts = recording.column(recording.shown)[rows]
        return pack(taxel_masks(counts, no_contact[recording.reference[rows]], self._preset))


class _Shading:
    """Pictures of a gel without markers, as the change of their colours (n, 3, 128, 128)."""

    device, representation, one_reference = "camera", SHADING, False
    count = None
    attrs: Mapping[str, Any] = {}

    def __init__(self, preset: ShadingPreset) -> None:
        self._preset = preset

    def references(self, recording: Recording) -> Stored:
        return np.rint(self._no_contact(recording)).astype(np.uint8)

    def frames(self, recording: Recording, rows: Integers) -> Stored:
        no_contact = self._no_contact(recording)
        images, reference = recording.column(recording.shown)[rows], recording.reference[rows]
        cells = (cells_of(recording.picture(int(image)), self._preset) for image in images)
        return np.stack(list(map(shading_of, cells, no_contact[reference])))

    def _no_contact(self, recording: Recording) -> NDArray[np.float32]:
        """Return the colours without contact (k, 3, 128, 128) of each reference in use."""
        images = recording.reference_images()
        return np.stack([cells_of(recording.picture(image), self._preset) for image in images])


class RecordedSensor:
    """One sensor of an archive, made from sessions."""

    def __init__(
        self,
        name: str,
        recordings: Sequence[Recording],
        indenters: tuple[str, ...],
        preset_name: str | None = None,
        *,
        mm_per_px: float | None = None,
        unseen: tuple[str, ...] = UNSEEN,
        sam: EfficientSam | None = None,
        irregular: bool = False,
    ) -> None:
        """Prepare the segmentation of a sensor's frames.

        `preset_name`, by default that of the sensor's preset, is stored in the archive; `mm_per_px`
        [mm] replaces the preset's, `sam` refines masks of pictures, and `irregular` accepts
        references without a regular pattern of markers.
        """
        preset_name = preset_name or preset_of_sensor(name)
        if preset_name is None:
            raise LearningError(
                f"{name}: no preset is assigned to it; allowed: {', '.join(names())}, or a .yaml "
                "file"
            )
        settings = preset(preset_name)
        self._frames: _Markers | _Taxels | _Shading
        if isinstance(settings, TaxelPreset):
            self._frames = _Taxels(settings)
        elif isinstance(settings, ShadingPreset):
            self._frames = _Shading(settings)
        else:
            self._frames = _Markers(settings, preset_name, sam, irregular)
        kind = recordings[0].kind
        if kind != self._frames.device:
            raise LearningError(f"preset {preset_name}: is for {settings.KIND}; {name} has {kind}")
        scale = mm_per_px if mm_per_px is not None else settings.mm_per_px
        if scale is None:
            raise LearningError(f"{name}.mm_per_px: not in preset {preset_name}; allowed: say it")
        self._name, self._recordings = name, recordings
        self._indenters, self._unseen = indenters, unseen
        self._preset, self._preset_name, self._mm_per_px = settings, preset_name, scale
        self._ends = np.cumsum([0, *map(len, recordings)])
        self._first_reference = np.cumsum([0, *(len(one.references) for one in recordings)])

    @cached_property
    def plan(self) -> SensorPlan:
        """Plan of its part of the archive."""
        attrs: dict[str, Any] = {
            "made_from": "sessions",
            "sessions": [_identity(recording) for recording in self._recordings],
            "preset": self._preset_name,
            "preset_says": repr(self._preset),
            "wrench_frame": "that of the force/torque sensor, as in the sessions",
        }
        if self._recordings[0].finger:
            attrs["finger"] = self._recordings[0].finger
        if not isinstance(self._preset, TaxelPreset):
            first = self._recordings[0]
            shape = first.picture(first.reference_images()[0]).shape
            parts = [(each.start, each.stop) for each in shown_part(shape, self._preset.region)]
            if any(first for first, _ in parts):
                attrs["view"] = f"letterboxed to rows and columns {parts} of 640 x 480"
        if not all(recording.is_placed for recording in self._recordings):
            attrs |= {"depth": UNKNOWN, "position": UNKNOWN}
        own = self._recordings[:1] if self._frames.one_reference else self._recordings
        return SensorPlan(
            name=self._name,
            rows=int(self._ends[-1]),
            chunk_rows=CHUNK_ROWS,
            unit_rows=UNIT_ROWS,
            references=np.concatenate([self._frames.references(one) for one in own]),
            mm_per_px=self._mm_per_px,
            marker_count=self._frames.count,
            attrs={**attrs, **self._frames.attrs},
            representation=self._frames.representation,
        )

    def read(self, rows: slice) -> Frames:
        """Make some of the frames."""
        parts = []
        for index in range(len(self._recordings)):
            begin, end = int(self._ends[index]), int(self._ends[index + 1])
            first, last = max(rows.start, begin) - begin, min(rows.stop, end) - begin
            if first < last:
                parts.append(self._part(index, slice(first, last)))
        return Frames(
            np.concatenate([part.packed for part in parts]),
            {name: np.concatenate([part.table[name] for part in parts]) for name in parts[0].table},
            [line for part in parts for line in part.source],
        )

    def _part(self, index: int, rows: slice) -> Frames:
        recording = self._recordings[index]
        invalid = recording.invalid()[rows]
        there = np.array([not reason for reason in invalid])
        table = self._table(index, rows, there)
        frames = np.zeros((len(there), *self._frames.representation.shape), np.uint8)
        if there.any():
            frames[there] = self._frames.frames(recording, np.flatnonzero(there) + rows.start)
        flags = marker_flags(self._name, frames, table, self.plan.references, self._frames.count)
        lines = []
        run, target = recording.column("run")[rows], recording.column("target")[rows]
        squeezed = recording.squeezed()[rows]
        for row, reason in enumerate(invalid):
            line: dict[str, Any] = {
                "session": recording.name,
                "run": int(run[row]),
                "target": int(target[row]),
                **squeezed[row],
            }
            line |= {INVALID: reason} if reason else {}
            line |= {FLAG: flags[row]} if row in flags else {}
            lines.append(json.dumps(line, ensure_ascii=False))
        return Frames(frames, table, lines)

    def _table(self, index: int, rows: slice, there: NDArray[np.bool_]) -> dict[str, NDArray[Any]]:
        recording = self._recordings[index]
        target = recording.column("target")[rows].astype(np.int64)
        position = recording.positions()[rows]
        if not np.isfinite(position[there]).all():
            raise LearningError(f"{recording.name}: found NaN in pose of valid frames")
        # The format requires finite positions even in rows without a frame.
        position = np.where(np.isfinite(position), position, 0.0)
        wrench = recording.column("wrench")[rows].copy()
        wrench[~there] = np.nan
        wrench[:, ~recording.measured()] = np.nan
        wrench[~np.isfinite(wrench)] = np.nan
        place, location = recording.places()[rows], np.full(len(target), -1)
        if recording.first_location is not None:
            location = recording.first_location + place
        reference = self._first_reference[index] + recording.reference[rows]
        return {
            "indenter": np.full(len(target), self._indenters.index(recording.indenter)),
            "seen": np.full(len(target), recording.indenter not in self._unseen),
            "location": location,
            "target": recording.first_target + place,
            "phase": recording.column("phase")[rows],
            "depth": np.maximum(recording.surface()[rows] - position[:, 2], 0.0),
            "position": position[:, :2],
            "wrench": wrench,
            "frame": recording.number[rows],
            "t_ns": recording.column("t_ns")[rows],
            "reference": target * 0 if self._frames.one_reference else reference,
            "valid": there,
        }


def one_thread() -> None:
    """Limit OpenCV to one core: more gain little on pictures of this size."""
    cv2.setNumThreads(1)


def _identity(recording: Recording) -> dict[str, Any]:
    """Return the identity of a session, independent of its path."""
    attrs = recording.session.attrs
    return {
        "name": recording.name,
        "indenter": recording.indenter,
        "started_utc": attrs.get("started_utc"),
        "t0_ns": attrs.get("t0_ns"),
        "frames": len(recording),
    }
