"""From the deformation that one sensor shows to the one that another shows under the same press."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from learning.translation.field.deformation import (
    CHANNELS,
    SIDE,
    carried,
    coarse_growth,
    image_grid,
)
from learning.translation.field.field_net import UNIT_PX
from learning.translation.field.network import GROUPS, Contraction, FieldUnet

_LAYOUT = 8  # channels of a reference's layout, cell by cell
_SCALES = 4  # mm per column and per row of both images
_SCALE_MM = 0.05  # of a pixel, about which logarithms are taken


class LayoutEncoder(nn.Module):
    """What a reference tells of its sensor: where its markers are, and which sensor it is."""

    def __init__(self, width: int, numbers: int) -> None:
        """Build it: `width` channels inside, `numbers` of the sensor as a whole."""
        super().__init__()
        self.look = nn.Conv2d(1, width, 5, stride=2, padding=2)
        self.look_closer = nn.Conv2d(width, width, 3, stride=2, padding=1)
        self.layout = nn.Conv2d(width, _LAYOUT, 1)
        self.farther = nn.Conv2d(width, 2 * width, 3, stride=4, padding=1)
        self.norm = nn.GroupNorm(GROUPS, 2 * width)
        self.whole = nn.Linear(2 * width * 16, numbers)

    def forward(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """Return the layout (n, 8, 64, 64) and the numbers of the sensor (n, numbers).

        Args:
            distance: Signed distance of references (n, 1, 256, 256) [px].
        """
        features = functional.silu(self.look(distance / UNIT_PX))
        features = functional.silu(self.look_closer(features))
        far = functional.silu(self.norm(self.farther(features)))
        pooled = functional.adaptive_avg_pool2d(far, 4).flatten(1)
        return self.layout(features), self.whole(pooled)


class FieldMap(nn.Module):
    """What a target shows of a deformation that a source shows.

    It begins as the identity in millimetres. What it learns: where the source's contact lies in
    the target's image (an affine placement, sample by sample: sensors are pressed on grids of
    their own), and then what is to be added, growth of discs included. It is told of both sensors
    by their references and scales alone, so one model serves all pairs of a group.
    """

    def __init__(self, widths: Sequence[int], numbers: int) -> None:
        """Build it.

        Args:
            widths: Channels at 64, 32, 16, ... cells.
            numbers: That each sensor is described by.
        """
        super().__init__()
        condition = 2 * numbers + _SCALES
        self.source = LayoutEncoder(2 * GROUPS, numbers)
        self.target = LayoutEncoder(2 * GROUPS, numbers)
        shown = CHANNELS + 2
        narrow = [max(1, width // (2 * GROUPS)) * GROUPS for width in widths]
        self.placing = Contraction(shown, narrow, SIDE, condition)
        self.place = nn.Linear(narrow[-1], 6)
        for weights in self.place.parameters():
            nn.init.zeros_(weights)
        self.change = FieldUnet(shown + CHANNELS + 2 * _LAYOUT, CHANNELS, widths, SIDE, condition)

    def forward(
        self,
        deformation: Tensor,
        source_distance: Tensor,
        target_distance: Tensor,
        source_scale: Tensor,
        target_scale: Tensor,
    ) -> Tensor:
        """Return the target's deformation (n, 3, 64, 64) [px of its image].

        Args:
            deformation: The source's (n, 3, 64, 64) [px of its image].
            source_distance: Signed distance of the source's references (n, 1, 256, 256) [px].
            target_distance: The same of the target's.
            source_scale: Millimetres of a pixel (column, row) (n, 2).
            target_scale: The same of the target.
        """
        source_layout, source_numbers = self.source(source_distance)
        target_layout, target_numbers = self.target(target_distance)
        scales = (torch.cat([source_scale, target_scale], dim=1) / _SCALE_MM).log()
        condition = torch.cat([source_numbers, target_numbers, scales.to(source_numbers.dtype)], 1)
        places = image_grid(SIDE, SIDE, deformation.device).permute(0, 3, 1, 2)
        places = places.expand(len(deformation), -1, -1, -1)
        shown = torch.cat([deformation / UNIT_PX, places], dim=1).to(condition.dtype)
        whole = self.placing(shown, condition)[-1].mean(dim=(2, 3))
        placement = self.place(whole).float().view(-1, 2, 3)
        zoom = target_scale / source_scale
        identity = carried(deformation, zoom)
        placed = carried(deformation, zoom, placement)
        shown = torch.cat([placed / UNIT_PX, identity / UNIT_PX, places], dim=1)
        layouts = torch.cat([source_layout, target_layout], dim=1)
        change: Tensor = self.change(
            torch.cat([shown.to(layouts.dtype), layouts], dim=1), condition
        )
        return placed + coarse_growth(UNIT_PX * change.float())
