"""Training examples of a direct translator, drawn on the device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from learning.data.procedural import before, sample_patterns, untouched
from learning.translation.autoencoder.images import orient, scaled
from learning.translation.direct.aligned import AlignedImages
from learning.translation.direct.augmentation import Augmentation, disturb_source

Pair = tuple[int, int]
"""Numbers of a source and of a target sensor."""


@dataclass(frozen=True, slots=True, eq=False)
class Examples:
    """Images in 0..1 (n, 1, h, w) that belong together."""

    source: Tensor
    source_reference: Tensor
    given: Tensor
    """Whether the source's reference may be looked at (n,) bool."""
    reference: Tensor
    """Of the target."""
    target: Tensor
    """What is to be made."""


def all_pairs(sensors: int) -> tuple[Pair, ...]:
    """Return every directed pair of different sensors."""
    return tuple((i, j) for i in range(sensors) for j in range(sensors) if i != j)


def draw_examples(
    aligned: AlignedImages,
    pairs: Sequence[Pair],
    count: int,
    augmentation: Augmentation,
    generator: np.random.Generator,
) -> Examples:
    """Return random examples: the same ones for the same generator.

    Args:
        aligned: Images to draw from.
        pairs: Directions to train.
        count: How many examples.
        augmentation: What is done to them.
        generator: Of everything random.
    """
    moments = generator.integers(len(aligned), size=count)
    chosen = np.asarray(pairs)[generator.integers(len(pairs), size=count)]
    examples = examples_at(aligned, moments, chosen)
    source, target = examples.source, examples.target
    source_reference, reference = examples.source_reference, examples.reference
    random_source = generator.random(count) < augmentation.procedural_source
    random_target = generator.random(count) < augmentation.procedural_target
    # A random source lies on the target's surface, a random target on the source's, two on one.
    surface = np.where(random_source, chosen[:, 1], chosen[:, 0])
    for replaced, frame, rest in (
        (random_source, source, source_reference),
        (random_target, target, reference),
    ):
        _replace_by_patterns(aligned, moments, surface, replaced, (frame, rest), generator)
    source, source_reference = disturb_source(source, source_reference, augmentation, generator)
    images = [source, source_reference, reference, target]
    if augmentation.orientation:
        images = orient(images, generator)
    given = generator.random(count) >= augmentation.no_source_reference
    source, source_reference, reference, target = images
    return Examples(
        source=source,
        source_reference=source_reference,
        given=torch.from_numpy(given).to(source.device),
        reference=reference,
        target=target,
    )


def examples_at(
    aligned: AlignedImages,
    moments: np.ndarray[tuple[int], np.dtype[np.int64]],
    pairs: np.ndarray[tuple[int, int], np.dtype[np.int64]],
) -> Examples:
    """Return examples as they are in an archive.

    Args:
        aligned: Images to take them from.
        moments: Which moments (n,).
        pairs: Source and target of each (n, 2).
    """
    device = aligned.images.device
    moment = torch.from_numpy(moments).to(device)
    source, target = torch.from_numpy(np.ascontiguousarray(pairs.T)).to(device)
    return Examples(
        source=scaled(aligned.images[source, moment]),
        source_reference=scaled(aligned.references[aligned.reference[source, moment]]),
        given=torch.ones(len(moment), dtype=torch.bool, device=device),
        reference=scaled(aligned.references[aligned.reference[target, moment]]),
        target=scaled(aligned.images[target, moment]),
    )


def _replace_by_patterns(
    aligned: AlignedImages,
    moments: np.ndarray[tuple[int], np.dtype[np.int64]],
    surface: np.ndarray[tuple[int], np.dtype[np.int64]],
    replaced: np.ndarray[tuple[int], np.dtype[np.bool_]],
    images: tuple[Tensor, Tensor],
    generator: np.random.Generator,
) -> None:
    """Put random patterns in the place of frames and references, where surfaces have a field.

    Args:
        aligned: Where the fields are.
        moments: Of the examples (n,).
        surface: Sensor whose surface each example shows (n,).
        replaced: Which examples are to be replaced (n,).
        images: Frames and references (n, 1, h, w); changed in place.
        generator: Of the patterns.
    """
    if aligned.fields is None:
        return
    owner = np.asarray(aligned.field_of)[surface]
    rows = np.flatnonzero(replaced & (owner >= 0))
    if not rows.size:
        return
    frames, references = images
    device, side = frames.device, frames.shape[-1]
    where = torch.from_numpy(rows).to(device)
    field = aligned.fields[
        torch.from_numpy(owner[rows]).to(device), torch.from_numpy(moments[rows]).to(device)
    ]
    patterns = sample_patterns(len(rows), generator, device)
    frames[where] = patterns.draw(before(field, aligned.lattice, side))
    references[where] = patterns.draw(untouched(side, device))
