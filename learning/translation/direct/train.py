"""Training of the direct translator, from settings to command: stages two and three of the paper.

    tactile train direct ARCHIVE --split JSON --autoencoder RUN --out PRETRAINED
    tactile train direct ARCHIVE --split JSON --from PRETRAINED --out RUN
    torchrun --nproc-per-node 8 -m tactile train direct ...

It is first pretrained on simulated states, which show every pattern under every deformation, with
the encoder of an autoencoder. Each group of sensors is then fine-tuned on its location pairs. One
model serves all pairs of a group. All weights are trained except the reference encoder's.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from learning.archive_writer import archive_fingerprint
from learning.config import read_settings, require
from learning.errors import LearningError
from learning.train_command import open_data, run_training
from learning.training.checkpoint import read_model_folder
from learning.training.optim import Ema, set_rate
from learning.training.run import Session, accelerator, generator, seed_torch
from learning.translation.direct.autoencoder import Encoder, soft_dice
from learning.translation.direct.data import (
    AlignedImages,
    Pair,
    align,
    all_pairs,
    draw_examples,
    examples_at,
    group,
)
from learning.translation.direct.network import (
    DirectNetwork,
    PatchDiscriminator,
    discriminator_loss,
    generator_loss,
)
from learning.translation.direct.train_autoencoder import TrainingSettings, load_autoencoder

# Kind of model in its folder.
KIND = "direct"
# YAML files, one per preset.
PRESETS = Path(__file__).parent / "presets" / "translator"
# Steps between lines of the log.
LOG_EVERY = 25
# Betas of the adversary's AdamW, as in pix2pix (Isola et al. 2017).
ADVERSARY_BETAS = 0.5, 0.999


# Settings


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Amounts of augmentation; 0 or false: none. Lengths are in pixels of the networks' images."""

    procedural_source: float = 0.25
    """Fraction of samples whose source is a random pattern on the target's surface."""
    procedural_target: float = 0.25
    """Fraction of samples whose target is a random pattern on the source's surface."""
    no_source_reference: float = 0.1
    """Fraction of samples without the source's own reference."""
    orientation: bool = True
    """Mirror all images of a sample and rotate them by quarter turns."""
    edge: float = 0.8
    """Largest outward or inward shift of the marker edges of a source."""
    edge_frame: float = 0.2
    """Largest additional edge shift in a frame that its reference does not have."""
    drop: float = 0.05
    """Largest fraction of a source frame that is erased."""
    mount_shift: float = 3.0
    """Largest shift of a source and its reference along rows and columns."""
    mount_angle: float = 0.03
    """Largest rotation of both [rad]."""
    mount_scale: float = 0.02
    """Largest relative change of their scale."""


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Weights of the losses; a loss with weight 0 is not computed."""

    cross_entropy: float = 1.0
    """Cross-entropy of pixels."""
    dice: float = 1.0
    """1 - soft Dice of an image."""
    perceptual: float = 0.1
    """Mean absolute difference of features of the frozen reference encoder, at its three scales."""
    adversarial: float = 0.0
    """Loss of a discriminator; helps if the source does not determine the target (few taxels)."""


@dataclass(frozen=True, slots=True)
class DirectSettings(TrainingSettings):
    """Settings of a training, apart from its data and initial weights."""

    steps: int = 10_000
    batch: int = 128
    blocks: int = 4
    """Number of transformer blocks."""
    heads: int = 8
    """Number of attention heads; must divide the last width."""
    moving: bool = False
    """True if the decoder sees the reference's features at displaced positions."""
    pairs: Literal["supplement", "authors_code"] = "supplement"
    """Rule for pairing frames of two sensors, as in `recorder.archive`."""
    losses: LossWeights = field(default_factory=LossWeights)
    """Weights of the losses."""
    discriminator_width: int = 64
    """Channels of the discriminator's first layer, if there is one."""
    augmentation: Augmentation = field(default_factory=Augmentation)
    """Augmentation of training images."""

    def __post_init__(self) -> None:
        TrainingSettings.__post_init__(self)
        require(self, "blocks", "heads", least=1)
        if self.widths[-1] % self.heads:
            raise LearningError(
                f"heads: found {self.heads}; allowed: divisors of {self.widths[-1]}, the last width"
            )
        if self.launch.mixed_precision == "fp16" and self.losses.adversarial:
            raise LearningError(
                "launch.mixed_precision: found fp16 with an adversary, whose gradients need a "
                "separate scale; allowed: no, bf16"
            )

    @property
    def structure(self) -> dict[str, Any]:
        """Arguments of `DirectNetwork`."""
        return {name: getattr(self, name) for name in ("widths", "blocks", "heads", "moving")}


# Losses


def perceptual(encoder: Encoder, images: Tensor, targets: Tensor) -> Tensor:
    """Return the mean absolute difference of an encoder's features, averaged over its scales."""
    with torch.no_grad():
        wanted: Sequence[Tensor] = encoder(targets)
    found = encoder(images)
    gaps = [
        functional.l1_loss(one.float(), other.float())
        for one, other in zip(found, wanted, strict=True)
    ]
    return torch.stack(gaps).mean()


def reconstruction(
    logits: Tensor, targets: Tensor, encoder: Encoder, weights: LossWeights
) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the weighted reconstruction loss, and its parts for the log.

    Args:
        logits: Logits of the translated images (n, 1, h, w).
        targets: Anti-aliased images in 0..1 (n, 1, h, w).
        encoder: The frozen reference encoder.
        weights: Weights of the parts.
    """
    logits = logits.float()
    images = logits.sigmoid()
    parts: dict[str, Tensor] = {}
    if weights.cross_entropy:
        parts["cross_entropy"] = functional.binary_cross_entropy_with_logits(logits, targets)
    if weights.dice:
        parts["dice"] = 1 - soft_dice(images, targets).mean()
    if weights.perceptual:
        parts["perceptual"] = perceptual(encoder, images, targets)
    total = torch.zeros((), device=logits.device)
    for name, value in parts.items():
        total = total + getattr(weights, name) * value
    parts["l2"] = functional.mse_loss(images.detach(), targets)
    return total, parts


# Loop


def new_network(settings: DirectSettings, encoder: Encoder) -> DirectNetwork:
    """Return an untrained network with an autoencoder's encoder; deterministic in the settings."""
    seed_torch(settings.seed, "network")
    network = DirectNetwork(**settings.structure)
    network.start_from(encoder)
    return network


def train(
    network: DirectNetwork,
    aligned: AlignedImages,
    validation: AlignedImages | None,
    settings: DirectSettings,
    session: Session | None = None,
    *,
    pairs: Sequence[Pair] | None = None,
) -> DirectNetwork:
    """Train a network and return the running average of its weights.

    Args:
        network: Initial network, new or pretrained; it ends with the last step's weights.
        aligned: Training images.
        validation: Validation images of the same sensors; None: no validation.
        settings: Settings of the training.
        session: Surroundings of the training; None: in memory, on the device of the settings.
        pairs: Directions to train, as sensor indices; None: all.

    Raises:
        LearningError: Sensors of the validation differ from those of the training.
    """
    session = session or Session(accelerator(settings.launch))
    run, runs_on, device = session.run, session.accelerator, session.device
    pairs = all_pairs(len(aligned.sensors)) if pairs is None else pairs
    if validation is not None and validation.sensors != aligned.sensors:
        raise LearningError(
            f"validation: found sensors {', '.join(validation.sensors)}; allowed: "
            f"{', '.join(aligned.sensors)}"
        )
    mine = max(1, settings.batch // runs_on.num_processes)

    # Models and optimisers; the adversary has its own optimiser and is unused at weight 0
    network = network.to(device)
    learning = [weight for weight in network.parameters() if weight.requires_grad]
    optimiser = torch.optim.AdamW(
        learning, settings.learning_rate, weight_decay=settings.weight_decay
    )
    average = Ema(network, settings.average)
    models: dict[str, nn.Module] = {"network": network}
    states: dict[str, Any] = {"optimiser": optimiser, "average": average}
    weights = settings.losses
    seed_torch(settings.seed, "adversary")
    adversary = PatchDiscriminator(settings.discriminator_width).to(device)
    opponent = torch.optim.AdamW(
        adversary.parameters(), settings.learning_rate, betas=ADVERSARY_BETAS
    )
    if weights.adversarial:
        models["adversary"], states["opponent"] = adversary, opponent
    done = run.restore(models, states)
    wrapped, stepper = runs_on.prepare(network, optimiser)
    if weights.adversarial:
        judging, counter = runs_on.prepare(adversary, opponent)

    for step in range(done, settings.steps):
        # Examples: images (mine, 1, h, w) in 0..1
        chance = generator(settings.seed, "step", step, runs_on.process_index)
        batch = draw_examples(aligned, pairs, mine, settings.augmentation, chance)

        # Loss
        logits = wrapped(batch.source, batch.reference, batch.source_reference, batch.given)
        with runs_on.autocast():
            loss, parts = reconstruction(logits, batch.target, network.reference_encoder, weights)
        made = logits.float().sigmoid()
        if weights.adversarial:
            # Unwrapped and frozen: its weights do not change here and need no synchronisation.
            adversary.requires_grad_(False)
            parts["adversarial"] = generator_loss(adversary(made, batch.reference))
            loss = loss + weights.adversarial * parts["adversarial"]

        # A step of the network
        rate = settings.schedule.at(step)
        set_rate(optimiser, rate)
        stepper.zero_grad(set_to_none=True)
        runs_on.backward(loss)
        runs_on.clip_grad_norm_(learning, settings.clip)
        stepper.step()
        average.update(network)

        # A step of the adversary, on the images just generated
        if weights.adversarial:
            adversary.requires_grad_(True)
            both = torch.cat([batch.target, made.detach()])
            scores = judging(both, batch.reference.repeat(2, 1, 1, 1))
            parts["adversary"] = discriminator_loss(*scores.chunk(2))
            set_rate(opponent, rate)
            counter.zero_grad(set_to_none=True)
            runs_on.backward(parts["adversary"])
            runs_on.clip_grad_norm_(adversary.parameters(), settings.clip)
            counter.step()

        # Log, validation and checkpoint
        done = step + 1
        last, stop, score = done == settings.steps, session.passed(done, settings.steps), None
        if last or done % LOG_EVERY == 0:
            parts = {"loss": loss, **parts}
            run.log(done, {f"train/{name}": float(value.detach()) for name, value in parts.items()})
        if validation is not None and (last or done % settings.validate_every == 0):
            with average.applied(network):
                measured = validate(network, validation, pairs, settings)
            score = 1 - measured["dice"]
            run.log(done, {f"validation/{name}": value for name, value in measured.items()})
        if last or stop or done % settings.save_every == 0:
            run.save(done, {"model": average.weights, **models}, states, score=score)
        if stop:
            break

    if done == settings.steps:
        metadata = {"sensors": list(aligned.sensors)}
        run.finish(done, {"model": average.weights}, metadata=metadata)
    result = DirectNetwork(**settings.structure).to(device)
    result.load_state_dict(dict(average.weights))
    return result.eval()


@torch.no_grad()
def validate(
    network: DirectNetwork,
    aligned: AlignedImages,
    pairs: Sequence[Pair],
    settings: DirectSettings,
) -> dict[str, float]:
    """Return Dice and mean squared error of translations, and Dice of the unchanged reference.

    Moments are evenly spaced and always the same, and all directions occur equally often.
    """
    count = min(settings.validation_images, len(aligned) * len(pairs))
    moments = np.linspace(0, len(aligned) - 1, count).round().astype(np.int64)
    chosen = np.asarray(pairs, np.int64)[np.arange(count) % len(pairs)]
    sums = torch.zeros(3, device=aligned.images.device)
    network.eval()
    for first in range(0, count, settings.batch):
        part = slice(first, first + settings.batch)
        batch = examples_at(aligned, moments[part], chosen[part])
        logits = network(batch.source, batch.reference, batch.source_reference, batch.given)
        wanted = (batch.target > 0.5).float()
        found = (
            soft_dice((logits > 0).float(), wanted),
            soft_dice((batch.reference > 0.5).float(), wanted),
        )
        error = (logits.float().sigmoid() - batch.target).square().mean(dim=(1, 2, 3))
        sums += torch.stack([*found, error]).sum(dim=1)
    network.train()
    dice, no_contact, squared = (sums / count).tolist()
    return {"dice": dice, "dice_of_reference": no_contact, "l2": squared}


# Trained models, and the command


def load_network(
    folder: Path, device: torch.device | str = "cpu"
) -> tuple[DirectNetwork, DirectSettings]:
    """Return the network in a folder, and the settings it was trained with.

    Args:
        folder: A finished run of `train direct`, or one of its checkpoints.
        device: Device to compute on.

    Raises:
        LearningError: The folder does not exist, its model is of another kind, or its weights do
            not fit.
    """
    found = read_model_folder(folder, KIND)
    settings = found.settings(DirectSettings)
    return found.load(DirectNetwork(**settings.structure), device), settings


def run(options: argparse.Namespace) -> int:
    """Train as the options of `train direct` say; return the exit code."""
    settings = read_settings(DirectSettings, PRESETS, options.preset, options.set)
    archive, split = open_data(options)
    sensors = group(archive, split, options.sensors)
    if not len(split.locations("train")):
        raise LearningError(f"{options.split}: found no location to train on")
    folder = options.start or options.autoencoder
    mark = read_model_folder(folder).hash()
    if options.start is None:
        network = new_network(settings, load_autoencoder(folder).encoder)
    else:
        network, before = load_network(folder)
        for name, wanted in settings.structure.items():
            if wanted != (found := before.structure[name]):
                raise LearningError(f"{name}: found {wanted}; {folder} allows {found} alone")

    def train_it(session: Session) -> None:
        gather = functools.partial(
            align, archive, split, sensors=sensors, preset=settings.pairs, device=session.device
        )
        images = gather("train", progress=session.reading)
        measured = len(split.locations("validation")) > 0
        validation = gather("validation", fields=False) if measured else None
        with session.stop:
            train(network, images, validation, settings, session)

    data = [archive_fingerprint(archive), split.fingerprint, mark, *sensors]
    run_training(options.out, KIND, settings, data, train_it, resume=options.resume)
    return 0
