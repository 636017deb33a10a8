"""Training of the direct translator: second and third stage of the paper's training.

    python -m learning train-direct ARCHIVE --split JSON --autoencoder RUN --out PRETRAINED
    python -m learning train-direct ARCHIVE --split JSON --from PRETRAINED --out RUN
    torchrun --nproc-per-node 8 -m learning train-direct ...

It is first pretrained on simulated states, which show every pattern under every deformation, with
the encoder of an autoencoder. Each group of sensors is then fine-tuned on its location pairs. One
model serves all pairs of a group. All weights are trained except the reference encoder's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from learning.errors import LearningError
from learning.training.optim import Ema, set_rate
from learning.training.run import generator, seed_torch
from learning.translation.direct.autoencoder import soft_dice
from learning.translation.direct.data import (
    AlignedImages,
    Pair,
    all_pairs,
    draw_examples,
    examples_at,
)
from learning.translation.direct.losses import reconstruction
from learning.translation.direct.network import (
    DirectNetwork,
    PatchDiscriminator,
    discriminator_loss,
    generator_loss,
)
from learning.translation.direct.settings import DirectSettings

if TYPE_CHECKING:
    from accelerate import Accelerator

    from learning.training.run import RunFolder, Stop
    from learning.translation.direct.autoencoder import Encoder

# Steps between lines of the log.
LOG_EVERY = 25
# Betas of the adversary's AdamW, as in pix2pix (Isola et al. 2017).
ADVERSARY_BETAS = 0.5, 0.999


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
    launched: Accelerator,
    run: RunFolder | None = None,
    *,
    pairs: Sequence[Pair] | None = None,
    stop: Stop | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> DirectNetwork:
    """Train a network and return the running average of its weights.

    Args:
        network: Initial network, new or pretrained; it ends with the last step's weights.
        aligned: Training images.
        validation: Validation images of the same sensors; None: no validation.
        settings: Settings of the training.
        launched: Devices and precision.
        run: Folder for checkpoints and metrics; None: nothing is written.
        pairs: Directions to train, as sensor indices; None: all.
        stop: Ends training after the current step, so that it can be resumed.
        progress: Called with the number of steps done and the total.

    Raises:
        LearningError: Sensors of the validation differ from those of the training.
    """
    # Data
    device = launched.device
    pairs = all_pairs(len(aligned.sensors)) if pairs is None else pairs
    if validation is not None and validation.sensors != aligned.sensors:
        raise LearningError(
            f"validation: found sensors {', '.join(validation.sensors)}; allowed: "
            f"{', '.join(aligned.sensors)}"
        )
    ranks, rank = launched.num_processes, launched.process_index
    mine = max(1, settings.batch // ranks)

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
    first = 0 if run is None else run.restore(models, states)
    wrapped, stepper = launched.prepare(network, optimiser)
    if weights.adversarial:
        judging, counter = launched.prepare(adversary, opponent)

    for step in range(first, settings.steps):
        # Examples: images (mine, 1, h, w) in 0..1
        chance = generator(settings.seed, "step", step, rank)
        batch = draw_examples(aligned, pairs, mine, settings.augmentation, chance)

        # Loss
        logits = wrapped(batch.source, batch.reference, batch.source_reference, batch.given)
        with launched.autocast():
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
        launched.backward(loss)
        launched.clip_grad_norm_(learning, settings.clip)
        stepper.step()
        average.update(network)

        # A step of the adversary, on the images just generated
        if weights.adversarial:
            adversary.requires_grad_(True)
            both = torch.cat([batch.target, made.detach()])
            verdicts = judging(both, batch.reference.repeat(2, 1, 1, 1))
            parts["adversary"] = discriminator_loss(*verdicts.chunk(2))
            set_rate(opponent, rate)
            counter.zero_grad(set_to_none=True)
            launched.backward(parts["adversary"])
            launched.clip_grad_norm_(adversary.parameters(), settings.clip)
            counter.step()

        # Log, validation and checkpoint
        done = step + 1
        stopping = stop is not None and stop.agreed(launched)
        last = stopping or done == settings.steps
        score = None
        if run is not None and (done % LOG_EVERY == 0 or last):
            parts = {"loss": loss, **parts}
            run.log(done, {f"train/{name}": float(value.detach()) for name, value in parts.items()})
        if validation is not None and (done % settings.validate_every == 0 or last):
            with average.applied(network):
                measured = validate(network, validation, pairs, settings)
            score = 1 - measured["dice"]
            if run is not None:
                run.log(done, {f"validation/{name}": value for name, value in measured.items()})
        if run is not None and (done % settings.save_every == 0 or last):
            run.save(done, {"model": average.weights, **models}, states, score=score)
        progress(done, settings.steps)
        if stopping:
            break

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
    dice, untouched, squared = (sums / count).tolist()
    return {"dice": dice, "dice_of_reference": untouched, "l2": squared}
