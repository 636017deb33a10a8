"""How good a field model is on frames that it is not trained on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from learning.training.sampling import generator
from learning.translation.field.deformation import carried, render
from learning.translation.field.frames import Frames
from learning.translation.field.losses import dice, shift_error
from learning.translation.field.model import FieldModel

AT_ONCE = 64
"""Frames that are worked on together."""


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What the field net found in the sources of pairs; a frame is a source of many."""

    deformation: Tensor
    """(k, 3, 64, 64) float16 [px]."""
    place: Tensor
    """Row of `deformation` of each pair (m,) int64."""

    def of(self, pairs: Tensor) -> Tensor:
        """Return deformations of some pairs (n, 3, 64, 64) float32 [px]."""
        return self.deformation[self.place[pairs]].float()


@torch.no_grad()
def net_scores(model: FieldModel, frames: Frames, most: int, seed: int) -> dict[str, float]:
    """Return how well the field net explains frames of the sensors themselves.

    Args:
        model: In evaluation mode.
        frames: What it is measured on.
        most: So many of them at most, chosen by the seed.
        seed: Of the choice.

    Returns:
        `dice` of the deformed reference with the frame, `dice_still` of the reference as it is, and
        where the archive keeps displacement `shift_error_px`, its mean.
    """
    rows = _chosen(len(frames), most, seed, frames.device)
    scores: dict[str, list[Tensor]] = {"dice": [], "dice_still": [], "shift_error_px": []}
    for part in _parts(rows):
        images, distance = frames.seen(part), frames.distance(part)
        found = model.net(images, distance)[-1]
        scores["dice"].append(dice(render(distance, found), images))
        scores["dice_still"].append(dice(distance, images))
        if frames.shift is not None:
            shift = frames.shift[part].float()
            known = shift.isfinite().flatten(1).all(dim=1)
            scores["shift_error_px"].append(shift_error(found, shift)[known])
    return _means(scores)


@torch.no_grad()
def map_scores(
    model: FieldModel, frames: Frames, found: Found, most: int, seed: int
) -> dict[str, float]:
    """Return how well the map translates location pairs.

    Args:
        model: In evaluation mode.
        frames: What it is measured on.
        found: What the field net found in the sources, see `found_in_sources`.
        most: So many pairs at most, chosen by the seed.
        seed: Of the choice.

    Returns:
        `dice` with the target's frame, `dice_carried` of the source's deformation as it is in
        millimetres, `dice_still` of the target's reference as it is.
    """
    chosen = _chosen(len(frames.pairs), most, seed, frames.device)
    scores: dict[str, list[Tensor]] = {"dice": [], "dice_carried": [], "dice_still": []}
    for part in _parts(chosen):
        source, target = frames.pairs[part].unbind(dim=1)
        distance, images = frames.distance(target), frames.seen(target)
        scales = frames.scale(source), frames.scale(target)
        deformation = found.of(part)
        mapped = model.map(deformation, frames.distance(source), distance, *scales)
        still = carried(deformation, scales[1] / scales[0])
        scores["dice"].append(dice(render(distance, mapped), images))
        scores["dice_carried"].append(dice(render(distance, still), images))
        scores["dice_still"].append(dice(distance, images))
    return _means(scores)


@torch.no_grad()
def found_in_sources(model: FieldModel, frames: Frames) -> Found:
    """Return what the field net finds in the source of each pair."""
    every = torch.unique(frames.pairs[:, 0], return_inverse=True)
    sources, place = every[0], every[1]
    parts = [
        model.net(frames.seen(rows), frames.distance(rows))[-1].half() for rows in _parts(sources)
    ]
    return Found(torch.cat(parts), place)


def _chosen(count: int, most: int, seed: int, device: torch.device) -> Tensor:
    rows = generator(seed, "validation").permutation(count)[:most]
    return torch.from_numpy(rows).to(device)


def _parts(rows: Tensor) -> Iterator[Tensor]:
    return (rows[first : first + AT_ONCE] for first in range(0, len(rows), AT_ONCE))


def _means(scores: dict[str, list[Tensor]]) -> dict[str, float]:
    joined = {name: torch.cat(values) for name, values in scores.items() if values}
    return {name: float(values.mean()) for name, values in joined.items() if len(values)}
