"""Translation of presses in memory, many frames at once, on their device."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from learning.data.images import shrink_masks, unpack_masks
from learning.data.presses import Presses
from learning.markers.displacement import PackedPresses, fields_of_presses
from learning.translation.flow import warp_masks
from learning.translation.translator import SensorView, Translator

if TYPE_CHECKING:
    import torch


# Frames translated at once: 79 MB of masks.
_AT_ONCE = 256

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class TargetView:
    """References of the target for the frames of a source."""

    sensor: str
    """Name of the target."""
    view: SensorView
    """View of the target's images."""
    references: Tensor
    """Packed masks without contact (K, 38400) uint8, on the device."""
    reference: Tensor
    """Row of `references` for each frame of the source (N,) int64, on the CPU."""


def translate_presses(
    presses: Presses,
    look: TargetView,
    translator: Translator,
    *,
    progress: Progress = lambda done, total: None,
) -> Presses:
    """Translate presses to another sensor, as images.

    Frames are grouped by references, not by press, so the translator must depend on single frames
    and their reference only.

    Args:
        presses: Presses of the source, packed.
        look: References of the target.
        translator: Translator for this pair of sensors.
        progress: Called with the number of frames done and in total.
    """

    def seen(rows: Tensor, own: int, other: int) -> Tensor:
        masks = unpack_masks(presses.images[rows.to(presses.device)])
        before, after = presses.references[own : own + 1], look.references[other : other + 1]
        return translator.translate(masks, unpack_masks(after)[0], unpack_masks(before)[0])

    return _shown(presses, look, seen, progress)


def warp_presses(
    presses: Presses,
    look: TargetView,
    fields: Tensor,
    *,
    progress: Progress = lambda done, total: None,
) -> Presses:
    """Translate presses to another sensor by known displacement fields.

    Args:
        presses: Presses of the source, packed.
        look: References of the target.
        fields: Displacement in the target's image (N, 57, 73, 2) [px], on the CPU.
        progress: Called with the number of frames done and in total.
    """

    def seen(rows: Tensor, own: int, other: int) -> Tensor:
        after = unpack_masks(look.references[other : other + 1])[0]
        return warp_masks(after, fields[rows].to(presses.device).float())

    return _shown(presses, look, seen, progress)


def flow_fields(
    presses: Presses,
    source: SensorView,
    target: SensorView,
    *,
    processes: int = 1,
    progress: Progress = lambda done, total: None,
) -> Tensor:
    """Compute displacements (N, 57, 73, 2) float16 [px of the target's image] from tracked markers.

    Args:
        presses: Presses of the source, packed, each from its first frame on.
        source: View of its images.
        target: View of the target's images.
        processes: Number of processes.
        progress: Called with the number of frames done and in total.
    """
    packed = PackedPresses(
        presses.images.cpu().numpy(),
        presses.starts.numpy(),
        presses.references.cpu().numpy(),
        presses.reference.cpu().numpy(),
    )
    found = fields_of_presses(
        packed, source=source, target=target, processes=processes, progress=progress
    )
    return torch.from_numpy(found)


def _shown(
    presses: Presses,
    look: TargetView,
    seen: Callable[[Tensor, int, int], Tensor],
    progress: Progress,
) -> Presses:
    images = torch.empty(presses.frames, 256, 256, dtype=torch.uint8, device=presses.device)
    done = 0
    progress(0, presses.frames)
    for rows, own, other in _groups(presses.reference.cpu(), look.reference):
        images[rows.to(presses.device)] = shrink_masks(seen(rows, own, other))
        done += len(rows)
        progress(done, presses.frames)
    return replace(
        presses,
        sensor=f"{presses.sensor}-to-{look.sensor}",
        mm_per_px=look.view.mm_per_column,
        form="images",
        images=images,
        references=shrink_masks(unpack_masks(look.references)),
        reference=look.reference.to(presses.device),
    )


def _groups(own: Tensor, other: Tensor) -> Iterator[tuple[Tensor, int, int]]:
    """Yield rows (n,) that share both references, at most 256, and the references' rows."""
    both = np.stack([own.numpy(), other.numpy()], axis=1)
    for one, another in np.unique(both, axis=0).tolist():
        rows = torch.from_numpy(np.flatnonzero((both == (one, another)).all(axis=1)))
        for part in rows.split(_AT_ONCE):
            yield part, one, another
