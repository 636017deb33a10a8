"""How fast masks are made of a session's pictures or taxels, in CPU time of this machine."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from learning.errors import LearningError
from learning.markers.building import recorded_sensor
from learning.markers.centres import find_centres
from learning.markers.efficient_sam import EfficientSam
from learning.markers.frames import one_thread
from learning.markers.group import read_group
from learning.markers.preset import CameraPreset, TaxelPreset
from learning.markers.recording import Recording
from learning.markers.segmentation import Segmenter, grey
from learning.markers.taxels import taxel_masks
from recorder.markers import pack

FRAMES, REPEATS = 100, 3
"""Frames that are timed, and how often; the fastest time counts."""
CENTRES = "centres"
"""A step that an archive does without; it is told of and not in the sum."""


def rates(
    sessions: list[Path],
    *,
    preset_name: str | None = None,
    sensor: str | None = None,
    sam: EfficientSam | None = None,
) -> Iterator[str]:
    """Yield a line for each sensor: frames a second of an archive, and of each step alone.

    Raises:
        LearningError: Sessions that do not belong together, or a preset that does not fit.
        SessionError: A damaged session.
    """
    one_thread()
    group = read_group(sessions, sensor)
    for one in group.sensors:
        made = recorded_sensor(one, group, preset_name=preset_name, mm_per_px=1.0)
        recording = one.placed[0].recording
        found = made.preset
        if isinstance(found, CameraPreset):
            steps = _camera(recording, found, sam)
        else:
            steps = _taxels(recording, found)
        total = sum(seconds for name, seconds in steps.items() if name != CENTRES)
        parts = ", ".join(f"{name} {1 / seconds:,.0f}" for name, seconds in steps.items())
        yield f"{one.name}: {1 / total:,.0f} frames/s of one core ({parts})"


def _camera(
    recording: Recording, preset: CameraPreset, sam: EfficientSam | None
) -> dict[str, float]:
    """Return the seconds that each step takes for a frame."""
    camera = recording.session.streams["camera"]
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
    untouched = recording.session.reference["taxels"][recording.references[0]]
    masks = taxel_masks(counts, untouched, preset)
    return {
        "mask": _fastest(lambda: taxel_masks(counts, untouched, preset), len(counts)),
        "packing": _fastest(lambda: pack(masks), len(counts)),
    }


def _fastest(work: Callable[[], object], frames: int) -> float:
    """Return the CPU time that a frame takes [s], the least of some repeats."""
    spent = []
    for _ in range(REPEATS):
        began = time.process_time()
        work()
        spent.append(time.process_time() - began)
    return max(min(spent), 1e-9) / frames
