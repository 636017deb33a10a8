"""Both networks of the field translator, as they are saved together."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from learning.translation.field.field_map import FieldMap
from learning.translation.field.field_net import FieldNet
from learning.translation.field.settings import FieldSettings


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
