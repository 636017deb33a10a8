r"""Training of the marker autoencoder: SD-Turbo's with an adapter for marker images.

    python -m learning train-marker-vae sim.markers.zarr --split split.json --preset paper_main \
        --base sd-turbo --out runs/marker-vae

This is the first of the paper's three stages. Its adapter initialises the translator's encoder and
decoder, which are trained further, and the reference encoder, which stays frozen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.nn import functional

from learning.errors import LearningError
from learning.training.optim import set_rate
from learning.training.run import accelerator as launched
from learning.training.run import batch as sampled
from learning.training.run import generator as chance
from learning.translation.diffusion.data import unit
from learning.translation.diffusion.network import (
    VAE_ADAPTER,
    VAE_TARGETS,
    adapter_tensors,
    add_adapter,
    is_adapter,
    keep_in_state,
    posterior,
)
from learning.translation.diffusion.settings import MarkerVaeSettings

if TYPE_CHECKING:
    from accelerate import Accelerator

    from learning.training.run import RunFolder

_AT_ONCE = 16  # images evaluated at once


class MarkerVae(nn.Module):
    """SD-Turbo's autoencoder with an adapter, for images (n, 1, h, w) in [0, 1].

    Its state contains only the adapter.
    """

    def __init__(self, vae: Any, settings: MarkerVaeSettings) -> None:
        """Add the adapter."""
        super().__init__()
        add_adapter(vae, VAE_ADAPTER, settings.vae_rank, VAE_TARGETS, seed=settings.seed)
        if settings.gradient_checkpointing:
            vae.enable_gradient_checkpointing()
        self.vae = vae
        self.zero_one = settings.pixel_range == "zero_one"
        self.decode_scaled = settings.decode_scaled
        keep_in_state(self, is_adapter)

    def forward(
        self, images: torch.Tensor, noise: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return images, their reconstructions and the divergence of their latents.

        Args:
            images: Images (n, 1, h, w) in [0, 1].
            noise: Standard normal noise of a latent's shape; None: decode the posterior's mean.

        Returns:
            Images and their reconstructions (n, 3, h, w) in the network's range, and the
            divergence of each latent from the normal distribution (n,).
        """
        true = (images if self.zero_one else images * 2 - 1).expand(-1, 3, -1, -1)
        found = posterior(self.vae, true, 1.0)
        latent = found.at(noise)
        if self.decode_scaled:
            latent = latent * float(self.vae.config.scaling_factor)
        made = self.vae.decode(latent).sample.float()
        variance = found.deviation**2
        divergence = 0.5 * (found.mean**2 + variance - variance.log() - 1).sum(dim=(1, 2, 3))
        return true, made, divergence

    def adapter(self) -> dict[str, torch.Tensor]:
        """Return the adapter's tensors under the names of the translator's autoencoder."""
        return adapter_tensors(self.vae)


def train_vae(
    images: torch.Tensor,
    vae: Any,
    settings: MarkerVaeSettings,
    *,
    validation: torch.Tensor | None = None,
    run: RunFolder | None = None,
    accelerator: Accelerator | None = None,
    stopping: Callable[[], bool] = lambda: False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> MarkerVae:
    """Train the autoencoder and return it; with a run folder, resume from its latest checkpoint.

    Args:
        images: Training images of all patterns (n, h, w) uint8; copied to the device.
        vae: SD-Turbo's autoencoder; becomes part of the result.
        settings: Settings of the training.
        validation: Validation images; None: no validation.
        run: Folder for checkpoints and logs; None: nothing is written.
        accelerator: Devices and precision; None: from the settings.
        stopping: Returns True to save and stop after the current step.
        progress: Called with the number of steps done and the total.

    Raises:
        LearningError: There are no images, or a loss is not finite.
    """
    if not len(images):
        raise LearningError("images: found none; allowed: one or more")
    runs_on = accelerator or launched(settings.launch)
    device, rank, ranks = runs_on.device, runs_on.process_index, runs_on.num_processes
    images = images.to(device)
    validation = None if validation is None else validation.to(device)

    network = MarkerVae(vae, settings).to(device).train()
    learning = [each for each in network.parameters() if each.requires_grad]
    own = settings.optimiser
    wrapped, optimiser = runs_on.prepare(network, own.of(learning))
    states: dict[str, Any] = {"optimiser": optimiser}
    if runs_on.scaler is not None:
        states["scaler"] = runs_on.scaler

    done = 0 if run is None else run.restore({"model": network}, states)
    for step in range(done, settings.steps):
        set_rate(optimiser, own.rate.at(step))
        for part in range(settings.accumulation):
            number = step * settings.accumulation + part
            index = sampled(
                settings.seed, number, settings.batch, len(images), rank=rank, ranks=ranks
            )
            batch = unit(images[torch.from_numpy(index).to(device)])
            # Gradients are synchronised between devices only on the last batch of a step.
            last_part = part == settings.accumulation - 1
            with nullcontext() if last_part else runs_on.no_sync(wrapped):
                noise = _noise(batch, network, settings.seed, number, rank)
                losses = _losses(wrapped(batch, noise), settings)
                runs_on.backward(losses["loss"] / settings.accumulation)
        if own.clip_norm:
            runs_on.clip_grad_norm_(learning, own.clip_norm)
        optimiser.step()
        optimiser.zero_grad()
        done = step + 1
        progress(done, settings.steps)
        if done % settings.log_every == 0 or done in (1, settings.steps):
            reported = {f"train/{name}": float(loss.detach()) for name, loss in losses.items()}
            if not math.isfinite(reported["train/loss"]):
                raise LearningError(f"loss: found {reported} on step {done}; allowed: finite")
            if run is not None:
                run.log(done, reported)
        if run is None:
            continue
        stop, last = stopping(), done == settings.steps
        measured: dict[str, float] = {}
        if validation is not None and (done % settings.validate_every == 0 or last):
            measured = _evaluate(network, validation, settings, runs_on)
            run.log(done, measured)
        if done % settings.checkpoint_every == 0 or last or stop or measured:
            score = measured.get("validation/loss")
            run.save(done, {"model": network}, states, score=score)
        if last:
            run.finish(done, {"model": network}, score=measured.get("validation/loss"))
        if stop:
            break
    return network.eval()


def _losses(
    found: tuple[torch.Tensor, torch.Tensor, torch.Tensor], settings: MarkerVaeSettings
) -> dict[str, torch.Tensor]:
    """Return the total loss of the network's output, and its parts."""
    true, made, divergence = found
    parts = {
        "absolute": functional.l1_loss(made, true),
        "square": functional.mse_loss(made, true),
        "divergence": divergence.mean(),
    }
    loss = sum((getattr(settings, name) * part for name, part in parts.items()), true.new_zeros(()))
    return {"loss": loss, **{name: part.detach() for name, part in parts.items()}}


@torch.no_grad()
def _evaluate(
    network: MarkerVae, images: torch.Tensor, settings: MarkerVaeSettings, runs_on: Accelerator
) -> dict[str, float]:
    """Return mean losses on evenly spaced images, without random sampling."""
    count = min(settings.validated, len(images))
    chosen = torch.linspace(0, len(images) - 1, count).round().long().to(images.device)
    found: dict[str, float] = {}
    for part in torch.split(chosen, _AT_ONCE):
        with runs_on.autocast():
            losses = _losses(network(unit(images[part])), settings)
        for name, loss in losses.items():
            key = f"validation/{name}"
            found[key] = found.get(key, 0.0) + float(loss) * len(part) / count
    return found


def _noise(
    images: torch.Tensor, network: MarkerVae, seed: int, number: int, rank: int
) -> torch.Tensor:
    """Return standard normal noise of a latent's shape; it depends on seed, batch and rank."""
    generator = torch.Generator(images.device)
    generator.manual_seed(int(chance(seed, "noise", number, rank).integers(2**62)))
    config = network.vae.config
    smaller = 2 ** (len(config.block_out_channels) - 1)
    sides = (side // smaller for side in images.shape[2:])
    return torch.randn(
        (len(images), config.latent_channels, *sides), generator=generator, device=images.device
    )
