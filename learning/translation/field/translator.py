"""The learned field translator: the target's reference, moved as the source's frame says."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from learning.data.images import SIDE as IMAGE_SIDE
from learning.data.images import shrink_masks
from learning.errors import LearningError
from learning.training.checkpoint import read_model_folder
from learning.translation.field.network import (
    FieldMap,
    FieldNet,
    render,
    resampled,
    signed_distance,
)
from learning.translation.field.settings import FieldSettings
from learning.translation.translator import SensorView, require_masks, untouched_source
from recorder.markers import pack, unpack

# Both networks of the field translator, as they are saved together.


class FieldModel(nn.Module):
    """The field net and the map. Untrained, the map is the identity in millimetres."""

    def __init__(self, settings: FieldSettings) -> None:
        """Build both with weights drawn from the seed, the same on every machine."""
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(settings.seed)
            self.net = FieldNet(settings.net.widths, settings.net.refinements)
            self.map = FieldMap(settings.map.widths, settings.map.numbers)
        self.usual_scale: Tensor
        # Millimetres of a pixel (column, row) of most sensors trained on; a GelSight's until then.
        self.register_buffer("usual_scale", torch.tensor([0.0249, 0.0249]))

    def forward(
        self,
        frames: Tensor,
        source_distance: Tensor,
        target_distance: Tensor,
        source_scale: Tensor,
        target_scale: Tensor,
    ) -> Tensor:
        """Return the target's deformation (n, 3, 64, 64) [px of its image] of a source's frames.

        Args:
            frames: Of the source, in 0..1 (n, 1, 256, 256).
            source_distance: Signed distance of its references (n, 1, 256, 256) [px].
            target_distance: The same of the target's.
            source_scale: Millimetres of a pixel (column, row) (n, 2).
            target_scale: The same of the target.
        """
        deformation = self.net(frames, source_distance)[-1]
        mapped: Tensor = self.map(
            deformation, source_distance, target_distance, source_scale, target_scale
        )
        return mapped


_AT_ONCE = 64
_REFERENCES = 128  # distances that are kept, 1.2 MB each: a sensor that drifts has 90 references


@dataclass(frozen=True, slots=True, eq=False)
class FieldTranslator:
    """Finds the source's deformation, maps it to the target's and deforms the target's reference.

    A source without its reference cannot be read: markers are only known by where they were. In an
    ordered press that is its first frame.
    """

    name: str
    """How it is called in reports."""
    model: FieldModel
    """In evaluation mode, on the device where it computes."""
    source: SensorView | None = None
    """What the source's frames show; None: as much as the target's."""
    target: SensorView | None = None
    """What the target's would show."""

    def between(self, source: SensorView, target: SensorView) -> FieldTranslator:
        """Return the translator of two sensors whose pixels differ in size."""
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
        """Return the frames as the target would have shown them, bool (n, 480, 640).

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
        """Return millimetres of a pixel (1, 2); of an unknown sensor, those of most trained on."""
        if view is None:
            return self.model.usual_scale.unsqueeze(0)
        scale = (view.mm_per_column, view.mm_per_row)
        return self.model.usual_scale.new_tensor(scale).unsqueeze(0)


def _packed(reference: Tensor, what: str) -> bytes:
    masks = reference.cpu().numpy()
    if not masks.any():
        raise LearningError(f"{what}: found no marker; allowed: an untouched sensor's markers")
    return pack(masks).tobytes()


@functools.lru_cache(maxsize=_REFERENCES)
def _distance(packed: bytes, device: torch.device) -> Tensor:
    """Return the signed distance (1, 1, 480, 640) [px] of a packed mask."""
    mask = torch.from_numpy(unpack(np.frombuffer(packed, np.uint8)).copy())
    return signed_distance(mask.unsqueeze(0).to(device))


# A trained field model from its folder, ready to translate.

# Of model, in `config.yaml`.
KIND = "field"


def load(folder: Path, device: torch.device | str = "cpu") -> FieldTranslator:
    """Return the translator in the folder of a finished training run.

    Args:
        folder: Of the run, or of one of its checkpoints.
        device: Where it computes.

    Raises:
        LearningError: No model, one of another kind, or weights of another network.
    """
    found = read_model_folder(Path(folder), KIND)
    model = FieldModel(found.settings(FieldSettings))
    found.load(model)
    name = f"{KIND}[{found.hash()[:8]}]"
    return FieldTranslator(name, model.to(device).eval())
