"""The direct translator: source image and target reference to the target's image, in one pass.

As in the paper (Methods, "Image-conditioned diffusion model"), a trainable encoder reads the
source, a frozen one the target's reference, and the source attends to the reference. Unlike the
paper, there is no diffusion, and the source's reference is an optional input. The decoder also sees
features of the target's reference, because it has to reproduce its layout to the pixel: at their
original positions, or displaced as predicted from the tokens (trained by the output image only).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm

from learning.errors import LearningError
from learning.translation.direct.autoencoder import Decoder, Encoder

# Transformer blocks: tokens of a source image attend to each other and to a reference's tokens.


def positions(rows: int, columns: int, width: int, device: torch.device) -> Tensor:
    """Return sinusoidal positions (rows x columns, width): half of the width for each axis.

    Args:
        rows: Rows of the raster of tokens.
        columns: Columns of the raster.
        width: Channels of a token, a multiple of 4.
        device: Device of the result.
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
    """Multi-head attention of tokens to other tokens."""

    def __init__(self, width: int, heads: int) -> None:
        """Build it for tokens of `width` channels, split into `heads`."""
        super().__init__()
        self.heads = heads
        self.query = nn.Linear(width, width)
        self.key_value = nn.Linear(width, 2 * width)
        self.out = nn.Linear(width, width)

    def forward(self, tokens: Tensor, looked_at: Tensor) -> Tensor:
        """Return the attention (n, t, c) of tokens (n, t, c) to others (n, u, c)."""
        query = self._split(self.query(tokens))
        key, value = (self._split(part) for part in self.key_value(looked_at).chunk(2, dim=2))
        taken = functional.scaled_dot_product_attention(query, key, value)
        merged: Tensor = self.out(taken.transpose(1, 2).flatten(2))
        return merged

    def _split(self, tokens: Tensor) -> Tensor:
        count, length, width = tokens.shape
        return tokens.view(count, length, self.heads, width // self.heads).transpose(1, 2)


class TransformerBlock(nn.Module):
    """Residual self-attention, cross-attention to the reference, and perceptron."""

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
        """Return tokens (n, t, c) after attention to those of the reference (n, u, c)."""
        normed = self.norm_self(tokens)
        tokens = tokens + self.attend_self(normed, normed)
        tokens = tokens + self.attend_cross(self.norm_cross(tokens), reference)
        perceived: Tensor = self.perceptron(self.norm_perceptron(tokens))
        return tokens + perceived


# Initial value of the plane that replaces a missing source reference; no image has this value.
ABSENT = -1.0

# Largest displacement of the reference's features, as a fraction of the image's side: 96 columns.
FARTHEST = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class EncodedReference:
    """Target references encoded by the frozen encoder; reusable for every frame."""

    image: Tensor
    """References in 0..1 (n, 1, h, w)."""
    scales: tuple[Tensor, ...]
    """Features at 1/2, 1/4 and 1/8, finest first."""


class DirectNetwork(nn.Module):
    """Source encoder, frozen reference encoder, transformer blocks, decoder."""

    def __init__(
        self, widths: Sequence[int], blocks: int, heads: int, *, moving: bool = False
    ) -> None:
        """Build it with untrained weights; `start_from` copies those of an autoencoder.

        Args:
            widths: Channels at 1/2, 1/4 and 1/8, equal to those of the autoencoder.
            blocks: Number of transformer blocks at 1/8.
            heads: Number of attention heads.
            moving: True if the decoder sees the reference's features displaced as predicted from
                the tokens, otherwise at their original positions.
        """
        super().__init__()
        self.source_encoder = Encoder(widths, channels=2)
        self.absent = nn.Parameter(torch.full((1, 1, 1, 1), ABSENT))
        self.reference_encoder = Encoder(widths).requires_grad_(False)
        self.norm_reference = nn.LayerNorm(widths[-1])
        self.blocks = nn.ModuleList(TransformerBlock(widths[-1], heads) for _ in range(blocks))
        self.norm = nn.LayerNorm(widths[-1])
        self.way = nn.Conv2d(widths[-1], 2, 3, padding=1, bias=False) if moving else None
        if self.way is not None:
            # The initial displacement is zero.
            nn.init.zeros_(self.way.weight)
        self.decoder = Decoder(widths, skips=True)

    def start_from(self, encoder: Encoder) -> None:
        """Copy an autoencoder's encoder: frozen for references, as initial weights for sources.

        The source encoder initially ignores the source's reference.

        Raises:
            LearningError: The encoder has other widths.
        """
        weights = encoder.state_dict()
        if encoder.widths != self.reference_encoder.widths:
            raise LearningError(
                f"widths: found {encoder.widths} in the autoencoder; allowed: "
                f"{self.reference_encoder.widths}, the translator's widths"
            )
        self.reference_encoder.load_state_dict(weights)
        first = weights["halvings.0.weight"]
        weights["halvings.0.weight"] = torch.cat([first, torch.zeros_like(first)], dim=1)
        self.source_encoder.load_state_dict(weights)

    def encode_reference(self, reference: Tensor) -> EncodedReference:
        """Encode target references (n, 1, h, w) in 0..1."""
        with torch.no_grad():
            return EncodedReference(reference, tuple(self.reference_encoder(reference)))

    def forward(
        self,
        source: Tensor,
        reference: Tensor,
        source_reference: Tensor,
        given: Tensor,
    ) -> Tensor:
        """Return logits of the target's images (n, 1, h, w).

        Args:
            source: Images in 0..1 (n, 1, h, w).
            reference: Target references in 0..1 (n, 1, h, w).
            source_reference: The source's references (n, 1, h, w), any values where not given.
            given: True where the source's reference is given (n,), bool.
        """
        return self.translate(source, self.encode_reference(reference), source_reference, given)

    def translate(
        self,
        source: Tensor,
        reference: EncodedReference,
        source_reference: Tensor,
        given: Tensor,
    ) -> Tensor:
        """Return logits as `forward` does, for already encoded references (n or one)."""
        absent = self.absent.to(source.dtype)
        beside = torch.where(given[:, None, None, None], source_reference, absent)
        features = self.source_encoder(torch.cat([source, beside], dim=1))[-1]
        count, width, rows, columns = features.shape
        where = positions(rows, columns, width, features.device)
        tokens = features.flatten(2).transpose(1, 2) + where
        seen = reference.scales[-1].flatten(2).transpose(1, 2)
        seen = (self.norm_reference(seen) + where).expand(count, -1, -1)
        for block in self.blocks:
            tokens = block(tokens, seen)
        raster = self.norm(tokens).transpose(1, 2).reshape(count, width, rows, columns)
        skips = [reference.scales[1], reference.scales[0], reference.image]
        if self.way is not None:
            way = FARTHEST * torch.tanh(self.way(raster).float())
            skips = [fetched(skip, way) for skip in skips]
        logits: Tensor = self.decoder(raster + features, skips)
        return logits


def fetched(features: Tensor, way: Tensor) -> Tensor:
    """Return bilinearly sampled displaced features (n, c, h, w); zero beyond the border.

    Args:
        features: Features to sample (n or 1, c, h, w).
        way: Offset to the sampled position, across and down, as fractions of the sides
            (n, 2, h', w').
    """
    count, height, width = len(way), *features.shape[2:]
    way = functional.interpolate(way, (height, width), mode="bilinear", align_corners=False)
    here = torch.eye(2, 3, device=way.device).expand(count, -1, -1)
    grid = functional.affine_grid(here, [count, 1, height, width], align_corners=False)
    grid = grid + 2 * way.permute(0, 2, 3, 1)
    features = features.float().expand(count, -1, -1, -1)
    with torch.autocast(way.device.type, enabled=False):
        return functional.grid_sample(features, grid, align_corners=False)


# A patch discriminator with spectral normalisation, for the adversarial part of the loss.
#
# Patches of 70 x 70 pixels as in pix2pix (Isola et al. 2017), hinge loss (Miyato et al. 2018). The
# paper's discriminator uses CLIP features; this one needs no pretrained weights.


class PatchDiscriminator(nn.Module):
    """Scores every patch of an image as real or generated, given the target's reference."""

    def __init__(self, width: int) -> None:
        """Build it with `width` channels in its first layer (64 in pix2pix)."""
        super().__init__()
        widths = [2, width, 2 * width, 4 * width, 8 * width]
        strides = (2, 2, 2, 1)
        self.layers = nn.ModuleList(
            spectral_norm(nn.Conv2d(before, after, 4, stride=stride, padding=1))
            for (before, after), stride in zip(pairwise(widths), strides, strict=True)
        )
        # Stored checkpoints have weights under this name.
        self.verdict = spectral_norm(nn.Conv2d(widths[-1], 1, 4, padding=1))

    def forward(self, images: Tensor, references: Tensor) -> Tensor:
        """Return scores (n, 1, h', w') of target images, given their references."""
        features = torch.cat([images, references], dim=1)
        for layer in self.layers:
            features = functional.leaky_relu(layer(features), 0.2)
        score: Tensor = self.verdict(features)
        return score


def generator_loss(scores: Tensor) -> Tensor:
    """Return the generator's hinge loss for scores of its images."""
    return -scores.float().mean()


def discriminator_loss(real: Tensor, made: Tensor) -> Tensor:
    """Return the discriminator's hinge loss for scores of real and generated images."""
    return functional.relu(1 - real.float()).mean() + functional.relu(1 + made.float()).mean()
