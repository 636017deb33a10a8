"""The classical translator: the target's untouched mask, moved as the source's markers moved."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch

from learning.data.images import warp
from learning.markers.displacement import LATTICE, SMOOTHING, FieldReader, edge_level
from learning.translation.translator import FLOW, SensorView, require_masks, untouched_source
from recorder.markers import pack, unpack

# Masks warped by displacement fields, many at once, on any device.

# Frames warped at once: 64 take some 0.5 GB.
_TOGETHER = 64


def warp_masks(reference: torch.Tensor, fields: torch.Tensor) -> torch.Tensor:
    """Return a reference as it is seen after displacements, bool (n, 480, 640).

    Args:
        reference: The untouched mask, bool (480, 640), anywhere.
        fields: Displacement on the lattice of archives (n, 57, 73, 2) [px], components column, row;
            where they are, it is warped.
    """
    level = torch.tensor(edge_level(reference.cpu().numpy()), device=fields.device)
    parts = []
    for field in fields.split(_TOGETHER):
        seen = warp(level[None, None], field.permute(0, 3, 1, 2), LATTICE)
        parts.append(seen[:, 0] > 0.5)
    return torch.cat(parts)


_REFERENCES = 64  # readers that are kept: a sensor that drifts has one reference a contact point


@dataclass(frozen=True, slots=True)
class FlowTranslator:
    """Follows the source's markers, and warps the target's reference by what they did.

    A frame without a single marker says nothing: along a press it repeats the frame before, alone
    it gives the target's reference. Markers that are lost do what their neighbours do.
    """

    source: SensorView | None = None
    """What the source's frames show; None: the same as the target's."""
    target: SensorView | None = None
    """What the target's would show."""
    smoothing: float = SMOOTHING
    """How much the field may miss the markers to bend less (`Spline`)."""

    @property
    def name(self) -> str:
        """How it is called in reports."""
        return FLOW

    def between(self, source: SensorView, target: SensorView) -> FlowTranslator:
        """Return the translator of two sensors whose pixels differ in size."""
        return FlowTranslator(source, target, self.smoothing)

    def translate(
        self,
        source: torch.Tensor,
        target_reference: torch.Tensor,
        source_reference: torch.Tensor | None = None,
        *,
        ordered: bool = False,
    ) -> torch.Tensor:
        """Return the frames as the target would have shown them, bool (n, 480, 640).

        Markers are followed on the CPU, one thread; the warp is done where the frames are.

        Args:
            source: Masks of the source, bool (n, 480, 640), on any device; the result is on it too.
            target_reference: The untouched target, bool (480, 640).
            source_reference: The untouched source, bool (480, 640); None takes the first frame of
                an ordered press for it.
            ordered: The frames are one press in order of time, which begins untouched.

        Raises:
            LearningError: Wrong shapes or types, a reference that is needed and not there, or one
                without markers.
        """
        require_masks(source, target_reference, source_reference)
        if not len(source):
            return source.clone()
        source_reference = untouched_source(source, source_reference, ordered=ordered)
        reader = _reader(pack(source_reference.cpu().numpy()).tobytes(), self.smoothing)
        fields = reader.displacement(
            source.cpu().numpy(), ordered=ordered, source=self.source, target=self.target
        )
        return warp_masks(target_reference, torch.from_numpy(fields).to(source.device))


@functools.lru_cache(maxsize=_REFERENCES)
def _reader(packed: bytes, smoothing: float) -> FieldReader:
    return FieldReader(unpack(np.frombuffer(packed, np.uint8)), smoothing=smoothing)
