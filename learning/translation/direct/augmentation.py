"""What is done to training images on the device: errors of segmentation and mounting.

Images are (n, 1, h, w) in 0..1; everything random comes from a numpy generator, so that it is the
same when a training is resumed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True, slots=True)
class Augmentation:
    """How much is done; 0 or false: not at all. Lengths are in pixels of the nets."""

    procedural_source: float = 0.25
    """Share of samples whose source is a random pattern on the target's surface."""
    procedural_target: float = 0.25
    """Share of samples whose target is a random pattern on the source's surface."""
    no_source_reference: float = 0.1
    """Share of samples without the source's own reference."""
    orientation: bool = True
    """Mirror and turn all images of a sample by quarters."""
    edge: float = 0.8
    """Most by which the markers of a source grow or shrink at their edge."""
    edge_frame: float = 0.2
    """Most by which they do so in a frame and not in its reference."""
    drop: float = 0.05
    """Largest share of a source frame that is blotted out."""
    mount_shift: float = 3.0
    """Most by which a source and its reference are shifted, along rows and columns."""
    mount_angle: float = 0.03
    """Most by which they are turned [rad]."""
    mount_scale: float = 0.02
    """Most by which they are stretched, as a share."""


EDGE_SIGMA = 1.2
"""Of the blur under a threshold that is moved [px]."""
BLOTS = 8
"""Places at which an image may be blotted out."""
BLOT_RADIUS = 3.0, 9.0
"""Radius of a blot [px]: about that of a marker."""


def move_edges(images: Tensor, by: Tensor) -> Tensor:
    """Return images whose markers grew at their edge by (n,) [px], or shrank if negative.

    As a threshold does that is not where it should be: blurred, and cut at another level.
    """
    reach = int(3 * EDGE_SIGMA)
    steps = torch.arange(-reach, reach + 1, device=images.device, dtype=images.dtype)
    kernel = torch.exp(-0.5 * (steps / EDGE_SIGMA) ** 2)
    kernel = kernel / kernel.sum()
    padded = functional.pad(images, (reach,) * 4, mode="replicate")
    blurred = functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    blurred = functional.conv2d(blurred, kernel.view(1, 1, -1, 1))
    score = by.to(images.dtype) / EDGE_SIGMA
    level = torch.special.ndtr(-score)
    slope = torch.exp(-0.5 * score**2) / (EDGE_SIGMA * (2 * torch.pi) ** 0.5)
    cut: Tensor = 0.5 + (blurred - level[:, None, None, None]) / slope[:, None, None, None]
    return cut.clamp(0, 1)


def blot(images: Tensor, largest_share: float, generator: np.random.Generator) -> Tensor:
    """Return images with discs blotted out at random, up to a share of their area."""
    count, _, height, width = images.shape
    radius = generator.uniform(*BLOT_RADIUS, (count, BLOTS))
    share = generator.uniform(0, largest_share, (count, 1))
    due = share * height * width / (np.pi * (radius**2).mean(axis=1, keepdims=True))
    radius = np.where(generator.random((count, BLOTS)) < due / BLOTS, radius, 0.0)
    centre = generator.random((count, BLOTS, 2)) * (height, width)
    rows = torch.arange(height, device=images.device)[:, None]
    columns = torch.arange(width, device=images.device)[None]
    kept = torch.ones((count, height, width), dtype=torch.bool, device=images.device)
    for place in range(BLOTS):
        row, column, size = (
            torch.from_numpy(np.asarray(value, np.float32)).to(images.device)[:, None, None]
            for value in (centre[:, place, 0], centre[:, place, 1], radius[:, place])
        )
        kept &= (rows - row) ** 2 + (columns - column) ** 2 >= size**2
    return images * kept.unsqueeze(1)


def remount(
    images: list[Tensor], options: Augmentation, generator: np.random.Generator
) -> list[Tensor]:
    """Return images of a sensor that sits a little elsewhere, all of one sample alike."""
    count, _, height, width = images[0].shape
    angle = generator.uniform(-1, 1, count) * options.mount_angle
    scale = 1 + generator.uniform(-1, 1, count) * options.mount_scale
    shift = generator.uniform(-1, 1, (count, 2)) * options.mount_shift * 2 / (width, height)
    cosine, sine = np.cos(angle) * scale, np.sin(angle) * scale
    matrix = np.stack(
        [
            np.stack([cosine, -sine, shift[:, 0]], axis=1),
            np.stack([sine, cosine, shift[:, 1]], axis=1),
        ],
        axis=1,
    )
    theta = torch.from_numpy(matrix.astype(np.float32)).to(images[0].device)
    grid = functional.affine_grid(theta, [count, 1, height, width], align_corners=False)
    return [functional.grid_sample(image, grid, align_corners=False) for image in images]


def disturb_source(
    frame: Tensor, reference: Tensor, options: Augmentation, generator: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return a source's frames and references as another mounting and segmentation show them."""
    count = len(frame)
    if options.mount_shift or options.mount_angle or options.mount_scale:
        frame, reference = remount([frame, reference], options, generator)
    if options.edge or options.edge_frame:
        both = generator.uniform(-options.edge, options.edge, count)
        alone = generator.uniform(-options.edge_frame, options.edge_frame, count)
        frame, reference = (
            move_edges(image, torch.from_numpy(by.astype(np.float32)).to(frame.device))
            for image, by in ((frame, both + alone), (reference, both))
        )
    if options.drop:
        frame = blot(frame, options.drop, generator)
    return frame, reference
