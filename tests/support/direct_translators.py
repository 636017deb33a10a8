"""Direct translators for tests: a few thousand weights, images of 32 x 32."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch.nn import functional

from learning.training.run import LaunchSettings, RunFolder
from learning.translation.direct import KIND, DirectNetwork
from learning.translation.direct.autoencoder import Autoencoder, Encoder
from learning.translation.direct.data import AlignedImages
from learning.translation.direct.train import Augmentation, DirectSettings, new_network

TINY = DirectSettings(
    description="of tests",
    widths=(8, 8, 16),
    blocks=1,
    heads=2,
    steps=4,
    batch=4,
    learning_rate=5e-3,
    warm_up=1,
    average=0.5,
    discriminator_width=8,
    launch=LaunchSettings(device="cpu"),
    validate_every=2,
    validation_images=4,
    save_every=2,
)
PLAIN = Augmentation(
    procedural_source=0,
    procedural_target=0,
    no_source_reference=0,
    orientation=False,
    edge=0,
    edge_frame=0,
    drop=0,
    mount_shift=0,
    mount_angle=0,
    mount_scale=0,
)
"""Nothing is changed in the images of a training."""


def encoder(widths: tuple[int, int, int] = (8, 8, 16)) -> Encoder:
    """Return the encoder of an autoencoder, with fixed weights."""
    torch.manual_seed(7)
    return Autoencoder(widths, 4).encoder


def tiny_network(settings: DirectSettings = TINY) -> DirectNetwork:
    """Return an untrained network."""
    return new_network(settings, encoder())


def finished_run(path: Path, settings: DirectSettings = TINY) -> None:
    """Write the folder of a finished run with untrained weights."""
    with RunFolder.open(path, KIND, settings, "data") as run:
        run.finish(settings.steps, {"model": tiny_network(settings)})


def coarse(aligned: AlignedImages) -> AlignedImages:
    """Return the same frames at an eighth of the size."""

    def shrunk(images: torch.Tensor) -> torch.Tensor:
        flat = images.flatten(0, -3).unsqueeze(1).float()
        small = functional.avg_pool2d(flat, 8).squeeze(1).round().to(torch.uint8)
        return small.unflatten(0, images.shape[:-2])

    return replace(aligned, images=shrunk(aligned.images), references=shrunk(aligned.references))
