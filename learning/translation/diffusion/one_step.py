"""One step of diffusion, from the last time at once to the clean latent, in closed form.

With one step, DDPM's update at t = 999 is the prediction of the clean latent itself: the weight of
the noisy latent and the added noise are both zero. So no scheduler is needed.
"""

from __future__ import annotations

import math
from functools import cache

import torch

TIMES = 1000
"""Times of Stable Diffusion's schedule."""
LAST_TIME = TIMES - 1
"""The one time that SD-Turbo is asked at."""
BETA_FIRST, BETA_LAST = 0.00085, 0.012
"""Noise variance of the first and the last time; square roots are evenly spaced between them
(Stable Diffusion's `scaled_linear` schedule)."""


@cache
def remaining_signal() -> float:
    """Return the share of the clean latent's variance that is left at the last time (0.00466)."""
    low, high = math.sqrt(BETA_FIRST), math.sqrt(BETA_LAST)
    return math.prod(1 - (low + (high - low) * time / LAST_TIME) ** 2 for time in range(TIMES))


def clean_latent(noisy: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    """Return the clean latent of a latent at the last time and the noise predicted in it.

    Computed in float32 whatever comes in: the two terms are 14.6 times as large as their
    difference.

    Args:
        noisy: Latent at the last time (n, channels, h, w), scaled.
        noise: What the network takes for noise, of the same shape.
    """
    signal = remaining_signal()
    # Autocast leaves sums and products with numbers in what they come in.
    rest = noisy.float() - math.sqrt(1 - signal) * noise.float()
    return rest / math.sqrt(signal)
