"""The direct translator: source image and target reference to the target's image, in one pass.

As in the paper (Methods, "Image-conditioned diffusion model") a trainable encoder reads the source,
a frozen one the target's reference, and the source attends to the reference; unlike there, nothing
diffuses, the source's own reference may be read too, and the decoder sees the features of the
target's reference, since it has to reproduce its layout to the pixel. It may see them where they
were, or where the tokens say that they went, which nothing but the image that comes out teaches.
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

# Transformer blocks: tokens of a source image look at each other and at those of a reference.


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


# First value of the plane that stands for a source reference nobody gave: no image has it.
ABSENT = -1.0

# Largest way that the reference's features go, as a share of the image's side: 96 columns.
FARTHEST = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class EncodedReference:
    """What the frozen encoder makes of target references; reusable for every frame."""

    image: Tensor
    """In 0..1 (n, 1, h, w)."""
    scales: tuple[Tensor, ...]
    """Features at 1/2, 1/4 and 1/8, finest first."""


class DirectNetwork(nn.Module):
    """Source encoder, frozen reference encoder, transformer blocks, decoder."""

    def __init__(
        self, widths: Sequence[int], blocks: int, heads: int, *, moving: bool = False
    ) -> None:
        """Build it with untrained weights; `start_from` gives it those of an autoencoder.

        Args:
            widths: Channels at 1/2, 1/4 and 1/8, those of the autoencoder.
            blocks: Transformer blocks at 1/8.
            heads: Of their attention.
            moving: Whether the decoder sees the reference's features where the tokens say that they
                went; else where they were.
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
            # At first nothing goes anywhere.
            nn.init.zeros_(self.way.weight)
        self.decoder = Decoder(widths, skips=True)

    def start_from(self, encoder: Encoder) -> None:
        """Take an autoencoder's encoder: to look at references for good, at sources to begin with.

        At first the source encoder does not see the source's reference.

        Raises:
            LearningError: An encoder of other widths.
        """
        weights = encoder.state_dict()
        if encoder.widths != self.reference_encoder.widths:
            raise LearningError(
                f"widths: found {encoder.widths} in the autoencoder; allowed: "
                f"{self.reference_encoder.widths}, as the translator has them"
            )
        self.reference_encoder.load_state_dict(weights)
        first = weights["halvings.0.weight"]
        weights["halvings.0.weight"] = torch.cat([first, torch.zeros_like(first)], dim=1)
        self.source_encoder.load_state_dict(weights)

    def encode_reference(self, reference: Tensor) -> EncodedReference:
        """Return what is seen in target references (n, 1, h, w) in 0..1."""
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
            source_reference: The source's own references (n, 1, h, w), anything where not given.
            given: Which of them are (n,), bool.
        """
        return self.translate(source, self.encode_reference(reference), source_reference, given)

    def translate(
        self,
        source: Tensor,
        reference: EncodedReference,
        source_reference: Tensor,
        given: Tensor,
    ) -> Tensor:
        """Return logits as `forward` does, of references that are encoded already (n or one)."""
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
    """Return features from elsewhere (n, c, h, w), bilinear; nothing comes from beyond the border.

    Args:
        features: What is fetched (n or 1, c, h, w).
        way: To where it is found, across and down as shares of the sides (n, 2, h', w').
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
# paper's discriminator sees through CLIP; this one needs no weights from elsewhere.


class PatchDiscriminator(nn.Module):
    """Says of every patch of an image whether it looks like one of the target's reference."""

    def __init__(self, width: int) -> None:
        """Build it with `width` channels in its first layer (64 in pix2pix)."""
        super().__init__()
        widths = [2, width, 2 * width, 4 * width, 8 * width]
        strides = (2, 2, 2, 1)
        self.layers = nn.ModuleList(
            spectral_norm(nn.Conv2d(before, after, 4, stride=stride, padding=1))
            for (before, after), stride in zip(pairwise(widths), strides, strict=True)
        )
        self.verdict = spectral_norm(nn.Conv2d(widths[-1], 1, 4, padding=1))

    def forward(self, images: Tensor, references: Tensor) -> Tensor:
        """Return verdicts (n, 1, h', w') on images of targets whose references are given."""
        features = torch.cat([images, references], dim=1)
        for layer in self.layers:
            features = functional.leaky_relu(layer(features), 0.2)
        verdict: Tensor = self.verdict(features)
        return verdict


def fooling(verdicts: Tensor) -> Tensor:
    """Return the generator's hinge loss of verdicts on its images."""
    return -verdicts.float().mean()


def telling(real: Tensor, made: Tensor) -> Tensor:
    """Return the discriminator's hinge loss of verdicts on real and on made images."""
    return functional.relu(1 - real.float()).mean() + functional.relu(1 + made.float()).mean()
