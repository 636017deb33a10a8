"""Transformer blocks: tokens of a source image look at each other and at those of a reference."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional


def positions(rows: int, columns: int, width: int, device: torch.device) -> Tensor:
    """Return sinusoidal positions (rows x columns, width): half of the width for each axis.

    Args:
        rows: Of the raster of tokens.
        columns: The same.
        width: Of a token, a multiple of 4.
        device: Where they are made.
    """
    quarter = width // 4
    rates = torch.exp(-math.log(1e4) * torch.arange(quarter, device=device) / quarter)
    along = [torch.arange(side, device=device)[:, None] * rates for side in (rows, columns)]
    row, column = (torch.cat([angle.sin(), angle.cos()], dim=1) for angle in along)
    grid = torch.cat(
        [
            row[:, None].expand(rows, columns, 2 * quarter),
            column[None].expand(rows, columns, 2 * quarter),
        ],
        dim=2,
    )
    return grid.reshape(rows * columns, width)


class Attention(nn.Module):
    """Multi-head attention of tokens on other tokens."""

    def __init__(self, width: int, heads: int) -> None:
        """Build it for tokens of `width` channels, cut into `heads`."""
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, tokens: Tensor, looked_at: Tensor) -> Tensor:
        """Return what tokens (n, t, c) take from others (n, u, c): (n, t, c)."""
        query = self._split(self.query(tokens))
        key, value = (self._split(part) for part in self.key_value(looked_at).chunk(2, dim=2))
        taken = functional.scaled_dot_product_attention(query, key, value)
        merged: Tensor = self.out(taken.transpose(1, 2).flatten(2))
        return merged

    def _split(self, tokens: Tensor) -> Tensor:
        count, length, width = tokens.shape
        return tokens.view(count, length, self.heads, width // self.heads).transpose(1, 2)


class TransformerBlock(nn.Module):
    """Attention on themselves, on the reference, then a perceptron; each beside the identity."""

    def __init__(self, width: int, heads: int) -> None:
        """Build it for tokens of `width` channels."""
        super().__init__()
        self.norm_self, self.norm_cross = nn.LayerNorm(width), nn.LayerNorm(width)
        self.norm_perceptron = nn.LayerNorm(width)
        self.attend_self, self.attend_cross = Attention(width, heads), Attention(width, heads)
        self.perceptron = nn.Sequential(
            nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width)
        )

    def forward(self, tokens: Tensor, reference: Tensor) -> Tensor:
        """Return tokens (n, t, c) after a look at those of the reference (n, u, c)."""
        normed = self.norm_self(tokens)
        tokens = tokens + self.attend_self(normed, normed)
        tokens = tokens + self.attend_cross(self.norm_cross(tokens), reference)
        perceived: Tensor = self.perceptron(self.norm_perceptron(tokens))
        return tokens + perceived
