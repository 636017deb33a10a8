"""Tokens for the UNet's cross-attention: the target's reference and, optionally, source.

The paper only states that the reference's latent is the condition of the cross-attention. Two
encodings are available:

* `channel_tokens`: one token per channel of the latent, with its pixels as features (authors'
  code). Has no parameters; needs as many pixels as the width of the cross-attention.
* `patch_tokens`: one token per 2 x 2 pixels of the latent, by a linear projection with positional
  encoding.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import nn

from learning.errors import LearningError

Conditioning = Literal["channel_tokens", "patch_tokens"]
# Side of a patch [px of the latent].
PATCH = 2


class ReferenceTokens(nn.Module):
    """Latents of references as tokens (n, count, width)."""

    def __init__(
        self, kind: Conditioning, *, channels: int, width: int, source_reference: bool
    ) -> None:
        """Build the layers.

        Args:
            kind: Encoding of tokens.
            channels: Channels of the latent.
            width: Width of the UNet's cross-attention.
            source_reference: True if the source's reference is also an input.
        """
        super().__init__()
        self.kind, self.width, self.source_reference = kind, width, source_reference
        if kind == "patch_tokens":
            self.projection = nn.Linear(channels * PATCH**2, width)
            self.norm = nn.LayerNorm(width)
        if source_reference:
            self.role = nn.Parameter(torch.randn(2, width) * 0.02)
            """Embeddings added to the tokens of the target and of the source."""

    def forward(self, target: torch.Tensor, source: torch.Tensor | None = None) -> torch.Tensor:
        """Return the tokens (n, count, width) of one or two latents (n, channels, h, w)."""
        if not self.source_reference:
            if source is not None:
                raise LearningError("source_reference: found one; this network reads none")
            return self._tokens(target)
        if source is None:
            raise LearningError("source_reference: missing; this network reads the source's own")
        both = self._tokens(target) + self.role[0], self._tokens(source) + self.role[1]
        return torch.cat(both, dim=1)

    def _tokens(self, latent: torch.Tensor) -> torch.Tensor:
        count, channels, height, width = latent.shape
        if self.kind == "channel_tokens":
            if height * width != self.width:
                raise LearningError(
                    f"channel_tokens: found a latent of {height} x {width}; allowed: "
                    f"{self.width} pixels, the width of the cross-attention"
                )
            return latent.reshape(count, channels, self.width)
        patches = nn.functional.pixel_unshuffle(latent, PATCH)
        rows, columns = patches.shape[2:]
        tokens = self.projection(patches.flatten(2).transpose(1, 2))
        places = sine_places(rows, columns, self.width).to(tokens)
        normed: torch.Tensor = self.norm(tokens + places)
        return normed


def sine_places(rows: int, columns: int, width: int) -> torch.Tensor:
    """Return positional encodings of a raster (rows x columns, width), in row-major order.

    Half of the features encode the row and half the column, by sines and cosines of falling
    frequency (Vaswani et al. 2017, once for each axis).
    """
    halves = width // 2, width - width // 2
    by_row = _sines(rows, halves[0])[:, None].expand(rows, columns, halves[0])
    by_column = _sines(columns, halves[1])[None].expand(rows, columns, halves[1])
    return torch.cat((by_row, by_column), dim=2).reshape(rows * columns, width)


def _sines(count: int, width: int) -> torch.Tensor:
    frequencies = torch.exp(torch.arange(0, width, 2) * (-math.log(10_000.0) / max(width, 1)))
    angles = torch.arange(count)[:, None] * frequencies
    return torch.stack((angles.sin(), angles.cos()), dim=2).flatten(1)[:, :width]
