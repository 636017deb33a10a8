"""Training of the marker autoencoder, from settings to command: the first stage of the paper's.

    tactile train autoencoder ARCHIVE --split split.json --out RUN [--preset ours]
    tactile train autoencoder --out RUN                  # random patterns alone
    torchrun --nproc-per-node 8 -m tactile train autoencoder ...

It learns to reconstruct images of any pattern, real, simulated or random. The direct translator
uses its encoder for references, and the evaluation uses its features.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from learning.archive_writer import archive_fingerprint
from learning.config import read_settings, require
from learning.data.images import SIDE, unit
from learning.data.presses import Progress, read_frames_of
from learning.data.splits import Role, Split, read_split
from learning.data.synthetic import before, random_fields, sample_patterns
from learning.errors import LearningError
from learning.train_command import run_training
from learning.training.checkpoint import read_model_folder
from learning.training.optim import Constant, Cosine, Ema, Schedule, set_rate
from learning.training.run import LaunchSettings, Session, accelerator, generator, seed_torch
from learning.translation.direct.autoencoder import (
    Autoencoder,
    divergence,
    orient,
    soft_dice,
)
from recorder import MarkerArchive

# Kind of model in its folder.
KIND = "autoencoder"
# YAML files, one per preset.
PRESETS = Path(__file__).parent / "presets" / "autoencoder"
# Steps between lines of the log.
LOG_EVERY = 25


# Settings


@dataclass(frozen=True, slots=True)
class TrainingSettings:
    """Settings of a training, apart from its data, that autoencoder and translator have."""

    description: str
    """Purpose of the preset."""
    widths: tuple[int, int, int] = (48, 96, 256)
    """Channels at 1/2, 1/4 and 1/8 of the side. Those of a translator equal its autoencoder's,
    whose last one is the number of pooled features."""
    steps: int = 20_000
    """Number of optimiser steps."""
    batch: int = 64
    """Batch size over all devices."""
    learning_rate: float = 3e-4
    """Peak rate of AdamW, reached after `warm_up` steps; decays to 0 as a cosine."""
    warm_up: int = 500
    """Number of steps over which the learning rate rises."""
    weight_decay: float = 1e-2
    """Weight decay of AdamW."""
    clip: float = 1.0
    """Gradient norm above which gradients are clipped."""
    average: float = 0.999
    """Decay of the running average of weights per step; the average is the model."""
    seed: int = 0
    """Seed of everything random."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices and precision."""
    validate_every: int = 500
    """Number of steps between validations."""
    validation_images: int = 512
    """Largest number of images in a validation."""
    save_every: int = 1000
    """Number of steps between checkpoints."""

    def __post_init__(self) -> None:
        require(self, "steps", "batch", "validate_every", "save_every", least=1)
        if any(width < 8 or width % 8 for width in self.widths):
            raise LearningError(f"widths: found {self.widths}; allowed: multiples of 8")

    @property
    def schedule(self) -> Schedule:
        """Learning rate by step.

        Raises:
            LearningError: Warm-up takes all steps, or the rate is invalid.
        """
        return Cosine(self.learning_rate, self.steps, self.warm_up)


@dataclass(frozen=True, slots=True)
class AutoencoderSettings(TrainingSettings):
    """Settings of an autoencoder and its training."""

    latent: int = 8
    """Channels of the latent."""
    absolute: float = 1.0
    """Weight of the mean absolute error (the paper, Methods)."""
    squared: float = 1.0
    """Weight of the mean squared error (the paper, Methods)."""
    divergence: float = 1e-6
    """Weight of the divergence from a standard normal, summed over an image (the paper)."""
    procedural: float = 0.5
    """Fraction of random patterns under made-up deformations; 1 without an archive."""
    orientation: bool = True
    """Mirror images and rotate them by quarter turns."""
    most_images: int = 100_000
    """Largest number of archive images in memory, chosen at random (64 KiB each)."""
    fall: Literal["cosine", "no"] = "cosine"
    """Decay of the learning rate to 0 at the last step."""

    def __post_init__(self) -> None:
        TrainingSettings.__post_init__(self)
        require(self, "latent", "most_images", least=1)
        require(self, "procedural", least=0, most=1)

    @property
    def schedule(self) -> Schedule:
        """Learning rate by step, constant after warm-up if it does not fall."""
        if self.fall == "no":
            return Constant(self.learning_rate, self.warm_up)
        return Cosine(self.learning_rate, self.steps, self.warm_up)


# Data: frames of archives, and random patterns


def read_images(
    archives: Sequence[tuple[MarkerArchive, Split]],
    role: Role,
    *,
    most: int,
    seed: int,
    device: torch.device | str = "cpu",
    progress: Progress = lambda done, total: None,
) -> Tensor:
    """Return frames (n, 256, 256) uint8 of a role from all sensors that no split holds out.

    Args:
        archives: Archives with their splits.
        role: Role of the locations to read.
        most: Largest number of frames, chosen at random.
        seed: Seed of the choice.
        device: Device for the images.
        progress: Called with the number of images read and the total.

    Raises:
        LearningError: A split belongs to another archive.
        SessionError: An archive is unfinished or damaged.
    """
    sensors, rows = [], []
    for archive, split in archives:
        split.check(archive)
        for name in split.trained_sensors(archive):
            sensors.append(archive[name])
            rows.append(split.rows(archive[name].table, role))
    count = sum(map(len, rows))
    chosen = np.sort(generator(seed, "images", role).permutation(count)[:most])
    taken, begin = [], 0
    for mine in rows:
        taken.append(mine[chosen[(chosen >= begin) & (chosen < begin + len(mine))] - begin])
        begin += len(mine)
    return read_frames_of(sensors, taken, device, progress)


def deformed_patterns(
    count: int, chance: np.random.Generator, device: torch.device, side: int = SIDE
) -> Tensor:
    """Return random patterns under made-up deformations (count, 1, side, side) in 0..1."""
    patterns = sample_patterns(count, chance, device)
    return patterns.draw(before(random_fields(count, chance, device), None, side))


def _draw(
    images: Tensor,
    count: int,
    procedural: float,
    side: int,
    chance: np.random.Generator,
    device: torch.device,
) -> Tensor:
    """Return a batch (count, 1, side, side) in 0..1 of random patterns and archive images."""
    made_up = int((chance.random(count) < procedural).sum())
    parts = [deformed_patterns(made_up, chance, device, side)] if made_up else []
    if made_up < count:
        chosen = torch.from_numpy(chance.integers(len(images), size=count - made_up))
        parts.append(unit(images[chosen.to(images.device)].to(device)))
    return torch.cat(parts)


# Loop


def new_autoencoder(settings: AutoencoderSettings) -> Autoencoder:
    """Return an untrained network; deterministic in the settings."""
    seed_torch(settings.seed, "network")
    return Autoencoder(settings.widths, settings.latent)


def train(
    images: Tensor,
    validation: Tensor,
    settings: AutoencoderSettings,
    session: Session | None = None,
) -> Autoencoder:
    """Train an autoencoder and return the running average of its weights.

    Args:
        images: Training images (n, h, w) uint8; if empty, only random patterns.
        validation: Validation images (m, h, w) uint8; if empty, random patterns of another seed.
        settings: Settings of the training.
        session: Surroundings of the training; None: in memory, on the device of the settings.

    Raises:
        LearningError: There are no images and the settings have no random patterns.
    """
    session = session or Session(accelerator(settings.launch))
    run, runs_on, device = session.run, session.accelerator, session.device

    # Data
    side = images.shape[-1] if len(images) else SIDE
    procedural = settings.procedural if len(images) else 1.0
    if not len(images) and not settings.procedural:
        raise LearningError("procedural: found 0 without images; allowed: more than 0, or archives")
    if not len(validation):
        chance = generator(settings.seed, "validation")
        drawn = deformed_patterns(min(64, settings.validation_images), chance, device, side)
        validation = (255 * drawn[:, 0]).round().to(torch.uint8)
    validation = validation[: settings.validation_images].to(device)
    mine = max(1, settings.batch // runs_on.num_processes)

    # Model and optimiser
    network = new_autoencoder(settings).to(device)
    optimiser = torch.optim.AdamW(
        network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
    )
    average = Ema(network, settings.average)
    states = {"optimiser": optimiser, "average": average}
    done = run.restore({"network": network}, states)
    wrapped, stepper = runs_on.prepare(network, optimiser)

    for step in range(done, settings.steps):
        # A batch: (mine, 1, side, side) in 0..1
        chance = generator(settings.seed, "step", step, runs_on.process_index)
        batch = _draw(images, mine, procedural, side, chance, device)
        if settings.orientation:
            (batch,) = orient([batch], chance)
        latent = (mine, settings.latent, side // 8, side // 8)
        noise = torch.from_numpy(chance.standard_normal(latent, np.float32)).to(device)

        # Losses
        logits, mean, log_variance = wrapped(batch, noise)
        made = logits.float().sigmoid()
        absolute, squared = functional.l1_loss(made, batch), functional.mse_loss(made, batch)
        apart = divergence(mean.float(), log_variance.float())
        loss = (
            settings.absolute * absolute + settings.squared * squared + settings.divergence * apart
        )

        # A step
        set_rate(optimiser, settings.schedule.at(step))
        stepper.zero_grad(set_to_none=True)
        runs_on.backward(loss)
        runs_on.clip_grad_norm_(wrapped.parameters(), settings.clip)
        stepper.step()
        average.update(network)

        # Log, validation and checkpoint
        done = step + 1
        last, stop, score = done == settings.steps, session.passed(done, settings.steps), None
        if last or done % LOG_EVERY == 0:
            parts = {"loss": loss, "l1": absolute, "l2": squared, "divergence": apart}
            run.log(done, {f"train/{name}": float(value.detach()) for name, value in parts.items()})
        if last or done % settings.validate_every == 0:
            with average.applied(network):
                measured = validate(network, validation, settings.batch)
            score = measured["l1"]
            run.log(done, {f"validation/{name}": value for name, value in measured.items()})
        if last or stop or done % settings.save_every == 0:
            run.save(done, {"model": average.weights, "network": network}, states, score=score)
        if stop:
            break

    if done == settings.steps:
        run.finish(done, {"model": average.weights})
    result = Autoencoder(settings.widths, settings.latent).to(device)
    result.load_state_dict(dict(average.weights))
    return result.eval()


@torch.no_grad()
def validate(network: Autoencoder, images: Tensor, batch: int) -> dict[str, float]:
    """Return mean absolute and squared errors and Dice coefficient of reconstructed images."""
    sums = torch.zeros(3, device=images.device)
    network.eval()
    for first in range(0, len(images), batch):
        part = images[first : first + batch]
        wanted = unit(part)
        made = network(wanted)[0].float().sigmoid()
        overlap = soft_dice((made > 0.5).float(), (wanted > 0.5).float())
        errors = (made - wanted).abs().mean(), (made - wanted).square().mean()
        sums += len(part) * torch.stack([*errors, overlap.mean()])
    network.train()
    absolute, squared, dice = (sums / len(images)).tolist()
    return {"l1": absolute, "l2": squared, "dice": dice}


# Trained models, and the command


def load_autoencoder(folder: Path, device: torch.device | str = "cpu") -> Autoencoder:
    """Return the autoencoder in a folder, in evaluation mode.

    Args:
        folder: A finished run of `train autoencoder`, or one of its checkpoints.
        device: Device to compute on.

    Raises:
        LearningError: The folder does not exist, its model is of another kind, or its weights do
            not fit.
    """
    found = read_model_folder(folder, KIND)
    settings = found.settings(AutoencoderSettings)
    return found.load(Autoencoder(settings.widths, settings.latent), device)


def run(options: argparse.Namespace) -> int:
    """Train as the options of `train autoencoder` say; return the exit code."""
    settings = read_settings(AutoencoderSettings, PRESETS, options.preset, options.set)
    if len(options.split) != len(options.archives):
        raise LearningError(
            f"--split: found {len(options.split)} for {len(options.archives)} archives; allowed: "
            "one for each"
        )
    archives = [
        (MarkerArchive(path), read_split(split))
        for path, split in zip(options.archives, options.split, strict=True)
    ]

    def train_it(session: Session) -> None:
        read = functools.partial(
            read_images,
            archives,
            seed=settings.seed,
            device=session.device,
            progress=session.reading,
        )
        images = read("train", most=settings.most_images)
        validation = read("validation", most=settings.validation_images)
        with session.stop:
            train(images, validation, settings, session)

    words = [
        word
        for archive, split in archives
        for word in (archive_fingerprint(archive), split.fingerprint)
    ]
    data = words or ["random patterns"]
    run_training(options.out, KIND, settings, data, train_it, resume=options.resume)
    return 0
