"""The learned field translator: deforms the target's reference according to the source frame."""

import functools
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
import torch
from torch import Tensor

from learning.data.images import SIDE as IMAGE_SIDE
from learning.data.images import shrink_masks
from learning.errors import LearningError
from learning.training.checkpoint import read_model_folder
from learning.translation.field.network import (
    KIND,
    FieldModel,
    MapSettings,
    NetSettings,
    render,
    resampled,
    signed_distance,
)
from learning.translation.translator import SensorView, require_masks, source_reference_of
from recorder.markers import pack, unpack

_AT_ONCE = 64
_REFERENCES = 128  # cached distances, 1.2 MB each: a drifting sensor has 90 references


@dataclass(frozen=True, slots=True, eq=False)
class FieldTranslator:
    """Finds the source's deformation, maps it to the target's and deforms the target's reference.

    The source's reference is required, because motion is measured relative to it. In an ordered
    press its first frame is the default.
    """

    name: str
    """Name in reports."""
    model: FieldModel
    """Model in evaluation mode, on its device."""
    source: SensorView | None = None
    """View of the source; None: the usual scale of the training."""
    target: SensorView | None = None
    """View of the target; None: likewise."""

    def between_sensors(self, source: SensorView, target: SensorView) -> Self:
        """Return the translator for two sensors whose pixels differ in size."""
        return replace(self, source=source, target=target)

    @torch.no_grad()
    def translate(
        self,
        source: Tensor,
        target_reference: Tensor,
        source_reference: Tensor | None = None,
        *,
        ordered: bool = False,
    ) -> Tensor:
        """Return the frames as the target would have shown them, as `Translator.translate`.

        A reference without markers is an error, too.
        """
        require_masks(source, target_reference, source_reference)
        if not len(source):
            return source.clone()
        source_reference = source_reference_of(source, source_reference, ordered=ordered)
        device = self.model.usual_scale.device
        full = _distance(_packed(target_reference, "target_reference"), device)
        small = resampled(full, IMAGE_SIDE)
        of_source = resampled(
            _distance(_packed(source_reference, "source_reference"), device), IMAGE_SIDE
        )
        scales = self._scale(self.source), self._scale(self.target)
        translated = torch.empty_like(source)
        for first in range(0, len(source), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            images = shrink_masks(source[part].to(device)).unsqueeze(1).float() / 255
            size = len(images)
            deformation = self.model(
                images,
                of_source.expand(size, -1, -1, -1),
                small.expand(size, -1, -1, -1),
                *(scale.expand(size, -1) for scale in scales),
            )
            level = render(full, deformation)
            translated[part] = (level.squeeze(1) > 0).to(source.device)
        return translated

    def _scale(self, view: SensorView | None) -> Tensor:
        """Return millimetres per pixel (1, 2); the usual scale if the sensor is unknown."""
        if view is None:
            return self.model.usual_scale.unsqueeze(0)
        scale = (view.mm_per_column, view.mm_per_row)
        return self.model.usual_scale.new_tensor(scale).unsqueeze(0)


def _packed(reference: Tensor, what: str) -> bytes:
    masks = reference.cpu().numpy()
    if not masks.any():
        raise LearningError(f"{what}: found no marker; allowed: a reference mask with markers")
    return pack(masks).tobytes()


@functools.lru_cache(maxsize=_REFERENCES)
def _distance(packed: bytes, device: torch.device) -> Tensor:
    """Return the signed distance (1, 1, 480, 640) [px] of a packed mask."""
    mask = torch.from_numpy(unpack(np.frombuffer(packed, np.uint8)).copy())
    return signed_distance(mask.unsqueeze(0).to(device))


def load(folder: Path, device: torch.device | str = "cpu") -> FieldTranslator:
    """Return the translator in the folder of a finished training run, or of a checkpoint of it."""
    stored = read_model_folder(Path(folder), KIND)
    model = FieldModel(stored.settings(NetSettings, "net"), stored.settings(MapSettings, "map"))
    return FieldTranslator(f"{KIND}[{stored.hash()[:8]}]", stored.load(model, device))
