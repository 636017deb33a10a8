"""The classical translator: warps the target's reference mask by the source's marker motion."""

import functools
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch

from learning.data.images import warp
from learning.markers.displacement import LATTICE, FieldReader, edge_level
from learning.translation.translator import FLOW, SensorView, require_masks, source_reference_of
from recorder.markers import pack, unpack

# Batched warping of masks by displacement fields, on any device.

# Frames warped at once: 64 take about 0.5 GB.
_TOGETHER = 64


def warp_masks(reference: torch.Tensor, fields: torch.Tensor) -> torch.Tensor:
    """Warp a reference (480, 640) by displacement fields; return masks, bool (n, 480, 640).

    Fields (n, 57, 73, 2) [px] have components column and row, on the lattice of archives; the warp
    runs on their device.
    """
    level = torch.tensor(edge_level(reference.cpu().numpy()), device=fields.device)
    parts = []
    for field in fields.split(_TOGETHER):
        warped = warp(level[None, None], field.permute(0, 3, 1, 2), LATTICE)
        parts.append(warped[:, 0] > 0.5)
    return torch.cat(parts)


_REFERENCES = 64  # cached readers: a drifting sensor has one reference per contact point


@dataclass(frozen=True, slots=True)
class FlowTranslator:
    """Tracks the source's markers and warps the target's reference by their displacement.

    A frame without any marker has no information: within an ordered press it repeats the previous
    frame, otherwise it yields the target's reference. Lost markers follow their neighbours.
    """

    source: SensorView | None = None
    """View of the source; None: the same as the target's."""
    target: SensorView | None = None
    """View of the target."""

    @property
    def name(self) -> str:
        """Name in reports."""
        return FLOW

    def between_sensors(self, source: SensorView, target: SensorView) -> Self:
        """Return the translator for two sensors whose pixels differ in size."""
        return replace(self, source=source, target=target)

    def translate(
        self,
        source: torch.Tensor,
        target_reference: torch.Tensor,
        source_reference: torch.Tensor | None = None,
        *,
        ordered: bool = False,
    ) -> torch.Tensor:
        """Return the frames as the target would have shown them, as `Translator.translate`.

        Markers are tracked on the CPU in one thread; the warp runs on the device of the frames.
        """
        require_masks(source, target_reference, source_reference)
        if not len(source):
            return source.clone()
        source_reference = source_reference_of(source, source_reference, ordered=ordered)
        reader = _reader(pack(source_reference.cpu().numpy()).tobytes())
        fields = reader.displacement(
            source.cpu().numpy(), ordered=ordered, source=self.source, target=self.target
        )
        return warp_masks(target_reference, torch.from_numpy(fields).to(source.device))


@functools.lru_cache(maxsize=_REFERENCES)
def _reader(packed: bytes) -> FieldReader:
    return FieldReader(unpack(np.frombuffer(packed, np.uint8)))
