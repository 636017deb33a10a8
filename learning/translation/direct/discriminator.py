"""A patch discriminator with spectral normalisation, for the adversarial part of the loss.

Patches of 70 x 70 pixels as in pix2pix (Isola et al. 2017), hinge loss (Miyato et al. 2018). The
paper's discriminator sees through CLIP; this one needs no weights from elsewhere.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.parametrizations import spectral_norm


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
