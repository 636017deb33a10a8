"""A U-Net over fields, which may be told what sensors it works for."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

GROUPS = 8
"""Groups of a group normalisation; every width is a multiple of it."""


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions beside the identity, told of a condition between them."""

    def __init__(self, before: int, width: int, condition: int) -> None:
        """Build a block.

        Args:
            before: Channels that come in.
            width: Channels that go out.
            condition: Numbers of the condition; 0: there is none.
        """
        super().__init__()
        self.norm_in = nn.GroupNorm(GROUPS, before)
        # What a bias would add the normalisation takes off again.
        self.convolution_in = nn.Conv2d(before, width, 3, padding=1, bias=False)
        self.norm_out = nn.GroupNorm(GROUPS, width)
        self.convolution_out = nn.Conv2d(width, width, 3, padding=1)
        self.pass_on = nn.Conv2d(before, width, 1) if before != width else nn.Identity()
        self.condition = nn.Linear(condition, 2 * width) if condition else None

    def forward(self, features: Tensor, condition: Tensor | None = None) -> Tensor:
        """Return features (n, width, h, w) of (n, before, h, w); condition (n, condition)."""
        inner = self.norm_out(self.convolution_in(functional.silu(self.norm_in(features))))
        if self.condition is not None:
            gain, offset = self.condition(condition)[:, :, None, None].chunk(2, dim=1)
            inner = inner * (1 + gain) + offset
        inner = self.convolution_out(functional.silu(inner))
        passed: Tensor = self.pass_on(features) + inner
        return passed


class Attention(nn.Module):
    """Every cell looks at every other: what lies far apart may belong together."""

    def __init__(self, width: int, heads: int, side: int) -> None:
        """Build attention over side x side cells."""
        super().__init__()
        self.norm = nn.GroupNorm(GROUPS, width)
        self.place = nn.Parameter(0.02 * torch.randn(1, width, side, side))
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)

    def forward(self, features: Tensor) -> Tensor:
        """Return features (n, width, side, side)."""
        cells = (self.norm(features) + self.place).flatten(2).transpose(1, 2)
        seen: Tensor = self.attention(cells, cells, cells, need_weights=False)[0]
        return features + seen.transpose(1, 2).reshape(features.shape)


class Contraction(nn.Module):
    """A field to features at its own side, half of it, and so on; the last have seen all of it."""

    def __init__(self, channels: int, widths: Sequence[int], side: int, condition: int = 0) -> None:
        """Build it.

        Args:
            channels: That come in.
            widths: Channels at the full side, its half, and so on.
            side: Of what comes in.
            condition: Numbers of the condition; 0: there is none.
        """
        super().__init__()
        self.begin = nn.Conv2d(channels, widths[0], 3, padding=1)
        self.blocks = nn.ModuleList(ResidualBlock(width, width, condition) for width in widths)
        self.halvings = nn.ModuleList(
            nn.Conv2d(width, wider, 3, stride=2, padding=1)
            for width, wider in itertools.pairwise(widths)
        )
        deepest = side // 2 ** (len(widths) - 1)
        # Heads of some 32 channels, as far as they divide the width.
        heads = math.gcd(widths[-1], max(1, widths[-1] // 32))
        self.attention = Attention(widths[-1], heads, deepest)
        self.last = ResidualBlock(widths[-1], widths[-1], condition)

    def forward(self, field: Tensor, condition: Tensor | None = None) -> list[Tensor]:
        """Return features, finest first, of (n, channels, side, side)."""
        features = self.blocks[0](self.begin(field), condition)
        scales = [features]
        for halving, block in zip(self.halvings, self.blocks[1:], strict=True):
            features = block(halving(features), condition)
            scales.append(features)
        scales[-1] = self.last(self.attention(features), condition)
        return scales


class FieldUnet(nn.Module):
    """A field to another of the same side; zero until it has learned."""

    def __init__(
        self, channels: int, out: int, widths: Sequence[int], side: int, condition: int = 0
    ) -> None:
        """Build it; `out` channels go out, the rest as in `Contraction`."""
        super().__init__()
        self.contraction = Contraction(channels, widths, side, condition)
        self.blocks = nn.ModuleList(
            ResidualBlock(width + wider, width, condition)
            for width, wider in zip(widths[-2::-1], widths[:0:-1], strict=True)
        )
        self.norm = nn.GroupNorm(GROUPS, widths[0])
        self.end = nn.Conv2d(widths[0], out, 3, padding=1)
        for weights in self.end.parameters():
            nn.init.zeros_(weights)

    def forward(self, field: Tensor, condition: Tensor | None = None) -> Tensor:
        """Return what comes out (n, out, side, side).

        Args:
            field: (n, channels, side, side).
            condition: (n, condition), where the net was built for one.
        """
        scales = self.contraction(field, condition)
        features = scales.pop()
        for block in self.blocks:
            features = functional.interpolate(features, scale_factor=2, mode="nearest")
            features = block(torch.cat([features, scales.pop()], dim=1), condition)
        found: Tensor = self.end(functional.silu(self.norm(features)))
        return found
