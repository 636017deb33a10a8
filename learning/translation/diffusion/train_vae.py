"""Training of the marker VAE, the first stage of `train diffusion`: settings, losses, loop.

The paper's translator needs SD-Turbo's autoencoder to know marker images: its adapter is trained on
the frames of all sensors. It initialises the translator's encoder and decoder, which are trained
further, and the reference encoder, which stays frozen.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.nn import functional

from learning.config import require
from learning.data.images import unit
from learning.errors import LearningError
from learning.training.optim import Constant, Cosine, set_rate
from learning.training.run import (
    LaunchSettings,
    Precision,
    RunFolder,
    TrainingSession,
    accelerator,
    generator,
)
from learning.training.run import batch as sampled
from learning.translation.diffusion.network import (
    MARKER_VAE,
    MarkerVae,
    VaeSettings,
    load_vae_adapter,
)
from learning.translation.diffusion.weights import BASE, fingerprint, read_vae
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from accelerate import Accelerator

_AT_ONCE = 16  # images evaluated at once


@dataclass(frozen=True, slots=True)
class Optimiser:
    """AdamW and its learning-rate schedule."""

    rate: Constant | Cosine
    """Learning rate over the steps."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decay of the running means of the gradient and its square."""
    epsilon: float = 1e-8
    """Constant added to the root of the mean square."""
    weight_decay: float = 1e-2
    """Weight decay per step, multiplied by the rate."""
    clip_norm: float = 1.0
    """Gradient norm above which gradients are clipped; 0: no clipping."""

    def __post_init__(self) -> None:
        require(self, "betas", least=0, most=0.999999)
        require(self, "epsilon", least=1e-12, most=1.0)
        require(self, "weight_decay", least=0, most=1.0)
        require(self, "clip_norm", least=0)

    def of(self, parameters: Iterable[nn.Parameter]) -> torch.optim.AdamW:
        """Return the optimiser for some parameters."""
        return torch.optim.AdamW(
            list(parameters),
            lr=self.rate.at(0),
            betas=self.betas,
            eps=self.epsilon,
            weight_decay=self.weight_decay,
        )


@dataclass(frozen=True, slots=True)
class VaeStage:
    """The stage of the marker VAE."""

    optimiser: Optimiser
    """AdamW of the adapter."""
    absolute: float = 1.0
    """Weight of the mean absolute error."""
    square: float = 1.0
    """Weight of the mean squared error."""
    divergence: float = 1e-6
    """Weight of the posterior's divergence from the normal distribution, summed over a latent."""
    decode_scaled: bool = False
    """True if the decoder takes the latent times its scaling factor, as in the authors' code. Their
    translator decodes it unscaled."""
    steps: int = 100_000
    """Steps of the optimiser; 0: the translator begins with an untrained adapter."""
    batch: int = 16
    """Batch size on one device, before accumulation."""
    accumulation: int = 1
    """Number of batches accumulated per step."""
    mixed_precision: Precision = "no"
    """Precision of the network; the losses are always float32."""

    def __post_init__(self) -> None:
        require(self, "absolute", "square", "divergence", "steps", least=0)
        require(self, "batch", "accumulation", least=1)


@dataclass(frozen=True, kw_only=True)
class MarkerVaeSettings(VaeSettings):
    """A marker VAE and its training; the translator's settings extend these."""

    description: str
    """Source of the numbers."""
    marker_vae: VaeStage
    """Stage of the marker VAE."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices, and the translator's precision; the step to the clean latent and the losses are
    always float32."""
    validated: int = 256
    """Largest number of validation images or pairs to evaluate."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    log_every: int = 25
    """Steps between lines in the log."""
    validate_every: int = 1000
    """Steps between validations."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "checkpoint_every", "log_every", "validate_every", least=1)

    def of_marker_vae(self) -> MarkerVaeSettings:
        """Return the settings that the marker VAE depends on, with its own precision."""
        values = {each.name: getattr(self, each.name) for each in fields(MarkerVaeSettings)}
        launch = replace(self.launch, mixed_precision=self.marker_vae.mixed_precision)
        return MarkerVaeSettings(**{**values, "launch": launch})


def _losses(
    outputs: tuple[torch.Tensor, torch.Tensor, torch.Tensor], stage: VaeStage
) -> dict[str, torch.Tensor]:
    """Return the total loss of the network's output, and its parts."""
    true, reconstruction, divergence = outputs
    parts = {
        "absolute": functional.l1_loss(reconstruction, true),
        "square": functional.mse_loss(reconstruction, true),
        "divergence": divergence.mean(),
    }
    loss = sum((getattr(stage, name) * part for name, part in parts.items()), true.new_zeros(()))
    return {"loss": loss, **{name: part.detach() for name, part in parts.items()}}


def train_vae(
    images: torch.Tensor,
    vae: Any,
    settings: MarkerVaeSettings,
    validation: torch.Tensor | None = None,
    session: TrainingSession | None = None,
) -> MarkerVae:
    """Train the autoencoder and return it.

    Images of all patterns (n, h, w) uint8 are copied to the device; SD-Turbo's autoencoder `vae`
    becomes part of the result. Without a session the training is in memory, on the device of the
    settings (`of_marker_vae`).
    """
    if not len(images):
        raise LearningError("images: found none; allowed: one or more")
    session = session or TrainingSession(accelerator(settings.launch))
    run, runs_on, device = session.run, session.accelerator, session.device
    rank, ranks = runs_on.process_index, runs_on.num_processes
    images = images.to(device)
    validation = None if validation is None else validation.to(device)

    stage = settings.marker_vae
    network = MarkerVae(vae, settings, decode_scaled=stage.decode_scaled).to(device).train()
    learning = [each for each in network.parameters() if each.requires_grad]
    own = stage.optimiser
    wrapped, optimiser = runs_on.prepare(network, own.of(learning))
    states: dict[str, Any] = {"optimiser": optimiser}
    if runs_on.scaler is not None:
        states["scaler"] = runs_on.scaler

    done, score = run.restore({"model": network}, states), None
    for step in range(done, stage.steps):
        set_rate(optimiser, own.rate.at(step))
        for part in range(stage.accumulation):
            number = step * stage.accumulation + part
            index = sampled(settings.seed, number, stage.batch, len(images), rank=rank, ranks=ranks)
            batch = unit(images[torch.from_numpy(index).to(device)])
            # Gradients are synchronised between devices only on the last batch of a step.
            last_part = part == stage.accumulation - 1
            with nullcontext() if last_part else runs_on.no_sync(wrapped):
                noise = _noise(batch, network, settings.seed, number, rank)
                losses = _losses(wrapped(batch, noise), stage)
                runs_on.backward(losses["loss"] / stage.accumulation)
        if own.clip_norm:
            runs_on.clip_grad_norm_(learning, own.clip_norm)
        optimiser.step()
        optimiser.zero_grad()

        # Log, validation and checkpoint
        done = step + 1
        last, stop, score = done == stage.steps, session.passed(done, stage.steps), None
        if last or done == 1 or done % settings.log_every == 0:
            reported = {f"train/{name}": float(loss.detach()) for name, loss in losses.items()}
            if not math.isfinite(reported["train/loss"]):
                raise LearningError(f"loss: found {reported} on step {done}; allowed: finite")
            run.log(done, reported)
        if validation is not None and (last or done % settings.validate_every == 0):
            measured = _evaluate(network, validation, settings, runs_on)
            score = measured["validation/loss"]
            run.log(done, measured)
        if last or stop or score is not None or done % settings.checkpoint_every == 0:
            run.save(done, {"model": network}, states, score=score)
        if stop:
            break
    if done == stage.steps:
        run.finish(done, {"model": network}, score=score)
    return network.eval()


@torch.no_grad()
def _evaluate(
    network: MarkerVae, images: torch.Tensor, settings: MarkerVaeSettings, runs_on: Accelerator
) -> dict[str, float]:
    """Return mean losses on evenly spaced images, without random sampling."""
    count = min(settings.validated, len(images))
    chosen = torch.linspace(0, len(images) - 1, count).round().long().to(images.device)
    means: dict[str, float] = {}
    for part in torch.split(chosen, _AT_ONCE):
        with runs_on.autocast():
            losses = _losses(network(unit(images[part])), settings.marker_vae)
        for name, loss in losses.items():
            key = f"validation/{name}"
            means[key] = means.get(key, 0.0) + float(loss) * len(part) / count
    return means


def _noise(
    images: torch.Tensor, network: MarkerVae, seed: int, number: int, rank: int
) -> torch.Tensor:
    """Return standard normal noise of a latent's shape; it depends on seed, batch and rank."""
    chance = torch.Generator(images.device)
    chance.manual_seed(int(generator(seed, "noise", number, rank).integers(2**62)))
    config = network.vae.config
    smaller = 2 ** (len(config.block_out_channels) - 1)
    sides = (side // smaller for side in images.shape[2:])
    return torch.randn(
        (len(images), config.latent_channels, *sides), generator=chance, device=images.device
    )


def marker_vae_of(
    settings: MarkerVaeSettings,
    data: str,
    read: Callable[[], Sequence[torch.Tensor]],
    session: TrainingSession,
) -> dict[str, torch.Tensor] | None:
    """Train or resume the marker VAE of a translator in `marker-vae/` of its run's folder.

    Returns the adapter; None if the training was stopped. `data` is the images' fingerprint; `read`
    reads those of training and validation (n, h, w) uint8, if they are needed.
    """
    own, base = settings.of_marker_vae(), fingerprint(settings.weights.base)
    folder, writes = session.run.path / MARKER_VAE, session.run.writes
    run = RunFolder.open(folder, MARKER_VAE, own, data, metadata={BASE: base}, writes=writes)
    with ItemProgress("steps of the marker VAE", sys.stderr) as steps:
        if not run.finished:
            images, validation = read()
            held = validation if len(validation) else None
            inner = TrainingSession(
                accelerator(own.launch), run, session.stop, steps, session.reading
            )
            with session.stop:
                train_vae(images, read_vae(own.weights.base), own, held, inner)
            if inner.stopping():
                return None
            inner.accelerator.wait_for_everyone()
    return load_vae_adapter(folder, base)
