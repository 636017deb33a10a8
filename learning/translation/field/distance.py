"""Signed distance of a marker image: what is warped instead of the image itself.

Its zero is the edge of the markers, so a warped one is thresholded with sub-pixel edges; a constant
that is added to it makes every marker grow by as many pixels, as the discs of a uSkin do under
pressure; and a loss on it has a gradient however far a marker is from where it should be.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

REACH_PX = 64
"""Distances are cut off here: a uSkin's disc grows from 12 to 54 px in radius."""
_BLUR_PX = 1.0
_NEAR_PX = 1.0  # up to here the blur says where an edge is, and from 1 px farther on nothing of it
_LEAST_PX = 0.01


def signed_distance(masks: Tensor, reach: int = REACH_PX) -> Tensor:
    """Return signed distances (n, 1, h, w) [px], positive on markers, float32.

    Far from an edge it is the distance to the nearest pixel of the other kind, less half a pixel.
    Pixels tell the place of an edge to a third of a pixel that way, and always too far inside of
    what is round; so near an edge it is what the mask, blurred by a Gaussian, says of a straight
    edge, to a twentieth. An image without markers is -reach everywhere.

    Args:
        masks: True on markers, bool (n, h, w).
        reach: Distances are cut off here [px].
    """
    outside = _distance_to(masks, reach) - 0.5
    inside = _distance_to(~masks, reach) - 0.5
    far = torch.where(masks, inside, -outside)
    away = (far.abs() - _NEAR_PX).clamp(0.0, 1.0)
    distance = torch.lerp(_distance_by_blur(masks), far, away)
    # A pixel keeps its kind, as little as a lone one differs from its surroundings.
    kept = torch.where(masks, distance.clamp(min=_LEAST_PX), distance.clamp(max=-_LEAST_PX))
    return kept.unsqueeze(1)


def resampled(distance: Tensor, side: int) -> Tensor:
    """Return distances (n, 1, h, w) at the pixel centres of side x side images of the same view."""
    small: Tensor = functional.interpolate(
        distance, size=(side, side), mode="bilinear", align_corners=False
    )
    return small


def _distance_by_blur(masks: Tensor) -> Tensor:
    """Return signed distances (n, h, w) [px] within 2 px of an edge, and something of like sign."""
    taps = torch.arange(-4, 5, device=masks.device, dtype=torch.float32)
    weights = torch.exp(-0.5 * (taps / _BLUR_PX).square())
    weights = weights / weights.sum()
    blurred: Tensor = functional.pad(masks.unsqueeze(1).float(), (4, 4, 4, 4), mode="replicate")
    blurred = functional.conv2d(blurred, weights.view(1, 1, 1, -1))
    blurred = functional.conv2d(blurred, weights.view(1, 1, -1, 1)).squeeze(1)
    # A pixel averages the edge over itself, which widens the blur.
    width = math.sqrt(_BLUR_PX**2 + 1 / 12)
    away: Tensor = torch.erfinv((2 * blurred - 1).clamp(-0.999, 0.999))
    return math.sqrt(2) * width * away


def _distance_to(masks: Tensor, reach: int) -> Tensor:
    """Return the distance (n, h, w) to the nearest True, at most `reach` [px].

    Along rows by running maxima; then, since squares add up, the least over all rows in reach.
    """
    height, width = masks.shape[-2:]
    place = torch.arange(width, device=masks.device, dtype=torch.float32)
    far = float(reach)
    last = torch.where(masks, place, -2 * far).cummax(dim=-1).values
    mirrored = torch.where(masks, -place, -2 * far - width).flip(-1)
    following = -mirrored.cummax(dim=-1).values.flip(-1)
    along = torch.minimum(place - last, following - place).clamp(max=far).square()
    best = along.clone()
    for offset in range(1, min(reach, height - 1) + 1):
        lower, upper = best[:, offset:], best[:, :-offset]
        torch.minimum(lower, along[:, :-offset] + offset**2, out=lower)
        torch.minimum(upper, along[:, offset:] + offset**2, out=upper)
    return best.sqrt().clamp(max=far)
