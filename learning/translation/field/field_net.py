"""From a frame and its untouched reference to the deformation between them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from learning.translation.field.deformation import CHANNELS, SIDE, coarse_growth, coverage, render
from learning.translation.field.network import FieldUnet

UNIT_PX = 16.0
"""What the networks count deformations in [px]: they see numbers around one."""


class FieldNet(nn.Module):
    """Finds a deformation look by look, at the frame and at the reference as deformed so far.

    What it says is what is missing. The reference goes in as a signed distance, so that the marker
    pattern is something to look at, not something to learn: patterns never seen before work.
    """

    def __init__(self, widths: Sequence[int], refinements: int) -> None:
        """Build it; the deformation is zero until it has learned.

        Args:
            widths: Channels at 128, 64, 32, ... cells.
            refinements: How often it looks.
        """
        super().__init__()
        self.refinements = refinements
        self.look = nn.Conv2d(2, widths[0], 5, stride=2, padding=2)
        self.look_closer = nn.Conv2d(widths[0], widths[1], 3, stride=2, padding=1)
        self.update = FieldUnet(widths[1] + CHANNELS, CHANNELS, widths[1:], SIDE)

    def forward(self, frames: Tensor, distance: Tensor) -> list[Tensor]:
        """Return deformations (n, 3, 64, 64) [px], one after every look, the last one the best.

        Args:
            frames: In 0..1, (n, 1, 256, 256).
            distance: Signed distance of the references (n|1, 1, 256, 256) [px].
        """
        deformation = frames.new_zeros(len(frames), CHANNELS, SIDE, SIDE)
        found: list[Tensor] = []
        for _ in range(self.refinements):
            with torch.no_grad():
                so_far = coverage(render(distance, deformation.float()))
            # 0..1 would leave an offset in every feature of mostly dark images.
            seen = torch.cat([frames - so_far, frames + so_far - 0.5], dim=1)
            features = self.look_closer(functional.silu(self.look(seen)))
            known = deformation.detach() / UNIT_PX
            missing = self.update(torch.cat([features, known.to(features.dtype)], dim=1))
            deformation = deformation.detach() + coarse_growth(UNIT_PX * missing.float())
            found.append(deformation)
        return found
