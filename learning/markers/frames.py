"""Frames of one sensor's sessions, computed from pictures or taxels on demand."""

from __future__ import annotations

import json
from functools import cached_property
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from learning.archive_writer import CHUNK_ROWS, UNIT_ROWS, Frames
from learning.errors import LearningError
from learning.indenters import UNSEEN
from learning.markers.flags import FLAG, INVALID, Flagger
from learning.markers.lattice import Lattice, with_reference
from learning.markers.recording import Placed, Recording, SensorGroup
from learning.markers.regular import spread_of
from learning.markers.segment import (
    CameraPreset,
    Picture,
    Preset,
    Segmenter,
    ShadingPreset,
    TaxelPreset,
)
from learning.markers.shading import cells_of, shading_of
from recorder.archive import MASKS, SHADING, MarkerCount, SensorPlan
from recorder.markers import HEIGHT, WIDTH, draw_discs, find_blobs, pack

if TYPE_CHECKING:
    from learning.markers.efficient_sam import EfficientSam

# Marker images of taxels: counts minus those without contact, drawn as discs.

_SIDE = 4


def taxel_masks(
    counts: NDArray[np.floating | np.integer],
    no_contact: NDArray[np.floating | np.integer],
    preset: TaxelPreset,
) -> NDArray[np.bool_]:
    """Draw the masks (n, 480, 640) of counts.

    Args:
        counts: Counts in the device's order (n, 16, 3) [counts].
        no_contact: Counts without contact (16, 3), or one set for each (n, 16, 3) [counts].
        preset: Numbering of the taxels.

    Raises:
        ValueError: A shape is wrong, or counts are not finite.
    """
    change = np.asarray(counts, np.float64) - np.asarray(no_contact, np.float64)
    if preset.rows_from_top:
        rows = change.reshape(*change.shape[:-2], _SIDE, _SIDE, 3)
        change = (rows[..., ::-1, :, :] * [1.0, -1.0, 1.0]).reshape(change.shape)
    return draw_discs(change)


Masks = NDArray[np.bool_]
# Depths and positions that nobody knows; `archive join` refuses them.
UNKNOWN = "unknown: 0"


class RecordedSensor:
    """One sensor of an archive, made from sessions."""

    def __init__(
        self,
        group: SensorGroup,
        indenters: tuple[str, ...],
        preset: Preset,
        *,
        preset_name: str,
        mm_per_px: float | None = None,
        unseen: tuple[str, ...] = UNSEEN,
        sam: EfficientSam | None = None,
        irregular: bool = False,
    ) -> None:
        """Prepare the segmentation of its frames.

        Args:
            group: Its sessions.
            indenters: Names, by code.
            preset: Settings of the marker detection.
            preset_name: Name of the preset, stored in the archive.
            mm_per_px: Size of a pixel [mm]; None: the preset's.
            unseen: Indenters that models may not be trained on.
            sam: Model that refines the masks; None: no refinement.
            irregular: True for markers without a regular pattern; False rejects their references.
        """
        of = "camera" if isinstance(preset, ShadingPreset) else preset.KIND
        if group.kind != of:
            raise LearningError(
                f"preset {preset_name}: is for {preset.KIND}; {group.name} has {group.kind}"
            )
        scale = mm_per_px if mm_per_px is not None else preset.mm_per_px
        if scale is None:
            raise LearningError(
                f"{group.name}.mm_per_px: not in preset {preset_name}; allowed: say it"
            )
        self._group, self._indenters, self._unseen = group, indenters, unseen
        self.preset, self._preset_name, self._mm_per_px = preset, preset_name, scale
        self._sam = sam
        self._irregular = irregular
        self._segmenter = Segmenter(preset) if isinstance(preset, CameraPreset) else None
        self._finders: dict[tuple[str, int], Segmenter | Lattice] = {}
        lengths = [len(placed.recording) for placed in group.placed]
        self._ends = np.cumsum([0, *lengths])

    @cached_property
    def plan(self) -> SensorPlan:
        """Plan of its part of the archive."""
        attrs: dict[str, Any] = {
            "made_from": "sessions",
            "sessions": [_identity(placed.recording) for placed in self._group.placed],
            "preset": self._preset_name,
            "preset_says": repr(self.preset),
            "wrench_frame": "that of the force/torque sensor, as in the sessions",
        }
        if not all(placed.recording.is_placed for placed in self._group.placed):
            attrs |= {"depth": UNKNOWN, "position": UNKNOWN}
        if self._sam is not None:
            attrs["efficient_sam"] = self._sam.identity
        count = None
        if isinstance(self.preset, CameraPreset):
            count = MarkerCount(self.preset.area_px[0], self.preset.tolerance)
        return SensorPlan(
            name=self._group.name,
            rows=int(self._ends[-1]),
            chunk_rows=CHUNK_ROWS,
            unit_rows=UNIT_ROWS,
            references=self._references,
            mm_per_px=self._mm_per_px,
            marker_count=count,
            attrs=attrs,
            representation=SHADING if isinstance(self.preset, ShadingPreset) else MASKS,
        )

    def read(self, rows: slice) -> Frames:
        """Make some of the frames."""
        parts = []
        for index, placed in enumerate(self._group.placed):
            begin, end = int(self._ends[index]), int(self._ends[index + 1])
            first, last = max(rows.start, begin) - begin, min(rows.stop, end) - begin
            if first < last:
                parts.append(self._part(index, placed, slice(first, last)))
        return Frames(
            np.concatenate([part.packed for part in parts]),
            {name: np.concatenate([part.table[name] for part in parts]) for name in parts[0].table},
            [line for part in parts for line in part.source],
        )

    @cached_property
    def _flagger(self) -> Flagger:
        return Flagger(self._group.name, self._references, self.plan.marker_count)

    @cached_property
    def _references(self) -> NDArray[np.uint8]:
        """Stored references (K, ...): packed masks or colours, recording by recording."""
        if isinstance(self.preset, ShadingPreset):
            stored = [self._no_contact(placed.recording) for placed in self._group.placed]
            return np.rint(np.concatenate(stored)).astype(np.uint8)
        if isinstance(self.preset, TaxelPreset):
            still = np.zeros((1, 16, 3))
            return pack(taxel_masks(still, np.zeros((16, 3)), self.preset))
        masks = []
        for placed in self._group.placed:
            recording = placed.recording
            images = recording.session.reference["image"][recording.references]
            for row, mask in zip(images, self._seen(recording, images), strict=True):
                blobs = find_blobs(mask[None], self.preset.area_px[0])
                if not len(blobs):
                    raise LearningError(
                        f"{recording.name}: preset {self._preset_name} finds no markers in its "
                        f"reference, image {row}; allowed: another preset, or --preset shading "
                        "for a gel without markers"
                    )
                spread = spread_of(blobs.only(blobs.whole))
                if not (self._irregular or spread.is_regular):
                    raise LearningError(
                        f"{recording.name}: preset {self._preset_name} finds no pattern of "
                        f"markers in its reference, image {row}: {spread}; allowed: --preset "
                        "shading for a gel without markers, another preset (tactile markers-fit "
                        "fits one), or --irregular if the markers have no pattern"
                    )
                masks.append(mask)
        return pack(np.stack(masks))

    def _no_contact(self, recording: Recording) -> NDArray[np.float32]:
        """Return the colours without contact (k, 3, 128, 128) of each reference in use."""
        images = recording.session.reference["image"][recording.references]
        return np.stack([self._cells(recording, int(row)) for row in images])

    def _cells(self, recording: Recording, image: int) -> NDArray[np.float32]:
        if not isinstance(self.preset, ShadingPreset):
            raise LearningError(f"{recording.name}: has no preset of shading")
        (picture,) = recording.camera.images([image])
        return cells_of(picture, self.preset)

    def _shading(self, recording: Recording, chosen: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return the shading (n, 3, 128, 128) of some rows of a recording."""
        no_contact = self._no_contact(recording)
        frames = np.empty((len(chosen), *SHADING.shape), np.uint8)
        for place, row in enumerate(chosen):
            cells = self._cells(recording, int(recording.column("image")[row]))
            frames[place] = shading_of(cells, no_contact[recording.reference[row]])
        return frames

    def _first_reference(self, index: int) -> int:
        if isinstance(self.preset, TaxelPreset):
            return 0
        return sum(len(placed.recording.references) for placed in self._group.placed[:index])

    def _part(self, index: int, placed: Placed, rows: slice) -> Frames:
        """Make frames of one recording."""
        recording = placed.recording
        invalid = recording.invalid()[rows]
        there = np.array([not reason for reason in invalid])
        table = self._table(index, placed, rows, there)
        reported = self._said(recording, rows, invalid)
        chosen = np.flatnonzero(there) + rows.start
        if isinstance(self.preset, ShadingPreset):
            frames = np.zeros((len(there), *SHADING.shape), np.uint8)
            if there.any():
                frames[there] = self._shading(recording, chosen)
            lines = [json.dumps(one, ensure_ascii=False) for one in reported]
            return Frames(frames, table, lines)
        masks = np.zeros((len(there), HEIGHT, WIDTH), np.bool_)
        if there.any():
            masks[there] = self._masks(recording, chosen)
        for row, flag in self._flagger.flags(masks, table["reference"], there).items():
            reported[row][FLAG] = flag
        lines = [json.dumps(one, ensure_ascii=False) for one in reported]
        return Frames(pack(masks), table, lines)

    def _masks(self, recording: Recording, chosen: NDArray[np.int64]) -> Masks:
        """Return the masks of some rows of a recording; each picture is processed once."""
        if isinstance(self.preset, TaxelPreset):
            counts = recording.column("taxels")[chosen]
            no_contact = recording.session.reference["taxels"][recording.references]
            return taxel_masks(counts, no_contact[recording.reference[chosen]], self.preset)
        images, first, place = np.unique(
            recording.column("image")[chosen], return_index=True, return_inverse=True
        )
        reference = recording.reference[chosen[first]]
        return self._seen(recording, images, reference)[place.reshape(-1)]

    def _seen(
        self,
        recording: Recording,
        images: NDArray[np.integer],
        references: NDArray[np.integer] | None = None,
    ) -> Masks:
        """Return the masks of pictures; without references, each is one itself."""
        masks = np.empty((len(images), HEIGHT, WIDTH), np.bool_)
        for place, row in enumerate(images):
            view = self._view(recording, int(row))
            finder = (
                self._segmenter_of(recording)
                if references is None
                else self._finder(recording, int(references[place]))
            )
            mask = finder.mask_of_view(view)
            if self._sam is not None:
                mask = self._sam.refined(view, mask, self._segmenter_of(recording).preset.box_px)
            masks[place] = mask
        return masks

    def _view(self, recording: Recording, image: int) -> Picture:
        (picture,) = recording.camera.images([image])
        return self._segmenter_of(recording).view(picture)

    def _segmenter_of(self, recording: Recording) -> Segmenter:
        if self._segmenter is None:
            raise LearningError(f"{recording.name}: has no pictures")
        return self._segmenter

    def _finder(self, recording: Recording, reference: int) -> Segmenter | Lattice:
        """Return what makes the masks of pictures of one reference; the last one is kept."""
        key = recording.name, reference
        if key not in self._finders:
            image = recording.session.reference["image"][recording.references][reference]
            view = self._view(recording, int(image))
            self._finders = {key: with_reference(self._segmenter_of(recording), view)}
        return self._finders[key]

    def _table(
        self, index: int, placed: Placed, rows: slice, there: NDArray[np.bool_]
    ) -> dict[str, NDArray[Any]]:
        recording = placed.recording
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
        location = np.full(len(target), -1)
        if placed.first_location is not None:
            location = placed.first_location + target
        of_taxels = isinstance(self.preset, TaxelPreset)
        reference = target * 0 if of_taxels else recording.reference[rows]
        return {
            "indenter": np.full(len(target), self._indenters.index(recording.indenter)),
            "seen": np.full(len(target), recording.indenter not in self._unseen),
            "location": location,
            "target": placed.first_target + target,
            "phase": recording.column("phase")[rows],
            "depth": np.maximum(recording.surface()[rows] - position[:, 2], 0.0),
            "position": position[:, :2],
            "wrench": wrench,
            "frame": recording.number[rows],
            "t_ns": recording.column("t_ns")[rows],
            "reference": self._first_reference(index) + reference,
            "valid": there,
        }

    def _said(self, recording: Recording, rows: slice, invalid: list[str]) -> list[dict[str, Any]]:
        """Return the provenance of each frame, and the reason if it is missing."""
        reported = []
        run, target = recording.column("run")[rows], recording.column("target")[rows]
        for place, reason in enumerate(invalid):
            line: dict[str, Any] = {
                "session": recording.name,
                "run": int(run[place]),
                "target": int(target[place]),
            }
            if reason:
                line[INVALID] = reason
            reported.append(line)
        return reported


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
