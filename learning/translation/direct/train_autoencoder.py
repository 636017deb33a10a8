"""Training of the marker autoencoder, the first stage of the paper's training.

    python -m learning train-autoencoder ARCHIVE --split split.json --out RUN [--preset ours]
    python -m learning train-autoencoder --out RUN                  # random patterns alone
    torchrun --nproc-per-node 8 -m learning train-autoencoder ...

It learns to reconstruct images of any pattern, real, simulated or random. The direct translator
uses its encoder for references, and the evaluation uses its features.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from learning.data.images import SIDE
from learning.errors import LearningError
from learning.training.optim import Ema, set_rate
from learning.training.run import generator, seed_torch
from learning.translation.direct.autoencoder import (
    Autoencoder,
    AutoencoderSettings,
    deformed_patterns,
    divergence,
    orient,
    scaled,
    soft_dice,
)

if TYPE_CHECKING:
    from accelerate import Accelerator

    from learning.training.run import RunFolder, Stop

# Steps between lines of the log.
LOG_EVERY = 25


def new_autoencoder(settings: AutoencoderSettings) -> Autoencoder:
    """Return an untrained network; deterministic in the settings."""
    seed_torch(settings.seed, "network")
    return Autoencoder(settings.widths, settings.latent)


def train(
    images: Tensor,
    validation: Tensor,
    settings: AutoencoderSettings,
    launched: Accelerator,
    run: RunFolder | None = None,
    *,
    stop: Stop | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Autoencoder:
    """Train an autoencoder and return the running average of its weights.

    Args:
        images: Training images (n, h, w) uint8; if empty, only random patterns.
        validation: Validation images (m, h, w) uint8; if empty, random patterns of another seed.
        settings: Settings of the training.
        launched: Devices and precision.
        run: Folder for checkpoints and metrics; None: nothing is written.
        stop: Ends training after the current step, so that it can be resumed.
        progress: Called with the number of steps done and the total.

    Raises:
        LearningError: There are no images and the settings have no random patterns.
    """
    # Data
    device, side = launched.device, images.shape[-1] if len(images) else SIDE
    procedural = settings.procedural if len(images) else 1.0
    if not len(images) and not settings.procedural:
        raise LearningError("procedural: found 0 without images; allowed: more than 0, or archives")
    if not len(validation):
        chance = generator(settings.seed, "validation")
        drawn = deformed_patterns(min(64, settings.validation_images), chance, device, side)
        validation = (255 * drawn[:, 0]).round().to(torch.uint8)
    validation = validation[: settings.validation_images].to(device)
    ranks, rank = launched.num_processes, launched.process_index
    mine = max(1, settings.batch // ranks)

    # Model and optimiser
    network = new_autoencoder(settings).to(device)
    optimiser = torch.optim.AdamW(
        network.parameters(), settings.learning_rate, weight_decay=settings.weight_decay
    )
    average = Ema(network, settings.average)
    states = {"optimiser": optimiser, "average": average}
    first = 0 if run is None else run.restore({"network": network}, states)
    wrapped, stepper = launched.prepare(network, optimiser)

    for step in range(first, settings.steps):
        # A batch: (mine, 1, side, side) in 0..1
        chance = generator(settings.seed, "step", step, rank)
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
        launched.backward(loss)
        launched.clip_grad_norm_(wrapped.parameters(), settings.clip)
        stepper.step()
        average.update(network)

        # Log, validation and checkpoint
        done = step + 1
        stopping = stop is not None and stop.agreed(launched)
        last = stopping or done == settings.steps
        score = None
        if run is not None and (done % LOG_EVERY == 0 or last):
            parts = {"loss": loss, "l1": absolute, "l2": squared, "divergence": apart}
            run.log(done, {f"train/{name}": float(value.detach()) for name, value in parts.items()})
        if done % settings.validate_every == 0 or last:
            with average.applied(network):
                measured = validate(network, validation, settings.batch)
            score = measured["l1"]
            if run is not None:
                run.log(done, {f"validation/{name}": value for name, value in measured.items()})
        if run is not None and (done % settings.save_every == 0 or last):
            run.save(done, {"model": average.weights, "network": network}, states, score=score)
        progress(done, settings.steps)
        if stopping:
            break

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
        wanted = scaled(part)
        made = network(wanted)[0].float().sigmoid()
        overlap = soft_dice((made > 0.5).float(), (wanted > 0.5).float())
        errors = (made - wanted).abs().mean(), (made - wanted).square().mean()
        sums += len(part) * torch.stack([*errors, overlap.mean()])
    network.train()
    absolute, squared, dice = (sums / len(images)).tolist()
    return {"l1": absolute, "l2": squared, "dice": dice}


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
        parts.append(scaled(images[chosen.to(images.device)].to(device)))
    return torch.cat(parts)
