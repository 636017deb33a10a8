"""Images that an autoencoder learns from: frames of any archives, random patterns, turned ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from learning.data.images import SIDE
from learning.data.presses import read_frames
from learning.data.procedural import before, random_fields, sample_patterns
from learning.data.splits import Role, Split
from learning.training.sampling import generator
from recorder import MarkerArchive


def read_images(
    archives: Sequence[tuple[MarkerArchive, Split]],
    role: Role,
    *,
    most: int,
    seed: int,
    device: torch.device | str = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Tensor:
    """Return frames of a role from all sensors that no split holds out (n, 256, 256) uint8.

    Args:
        archives: Each with the split that was made for it.
        role: Whose locations are taken.
        most: Of all frames, so many are chosen at random; fewer if there are fewer.
        seed: Of that choice.
        device: Where the images go.
        progress: Called with the images that are read and their number.

    Raises:
        LearningError: A split of another archive.
        SessionError: An archive that is unfinished or damaged.
    """
    sensors, rows = [], []
    for archive, split in archives:
        split.check(archive)
        for name in split.trained_sensors(archive):
            sensors.append(archive[name])
            rows.append(split.rows(archive[name].table, role))
    counts = [len(each) for each in rows]
    chosen = np.sort(generator(seed, "images", role).permutation(sum(counts))[:most])
    device = torch.device(device)
    images = torch.empty(len(chosen), SIDE, SIDE, dtype=torch.uint8, device=device)
    done = begin = 0
    for sensor, mine in zip(sensors, rows, strict=True):
        taken = mine[chosen[(chosen >= begin) & (chosen < begin + len(mine))] - begin]
        begin += len(mine)
        end = done + len(taken)
        images[done:end] = read_frames(sensor, taken, device)
        progress(end, len(chosen))
        done = end
    return images


def deformed_patterns(
    count: int, chance: np.random.Generator, device: torch.device, side: int = SIDE
) -> Tensor:
    """Return random patterns under made-up deformations (count, 1, side, side) in 0..1."""
    patterns = sample_patterns(count, chance, device)
    return patterns.draw(before(random_fields(count, chance, device), None, side))


def orient(images: list[Tensor], generator: np.random.Generator) -> list[Tensor]:
    """Return images mirrored and turned by quarters, all of one sample alike."""
    device, count = images[0].device, len(images[0])
    for dims in ((3,), (2,), None):
        chosen = torch.from_numpy(generator.random(count) < 0.5).to(device)[:, None, None, None]
        images = [
            torch.where(chosen, image.transpose(2, 3) if dims is None else image.flip(dims), image)
            for image in images
        ]
    return images


def scaled(images: Tensor) -> Tensor:
    """Return uint8 images (n, h, w) as float32 in 0..1 (n, 1, h, w)."""
    return images.unsqueeze(1).float() / 255
