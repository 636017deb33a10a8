r"""Training of the diffusion translator on location pairs.

    python -m learning train-diffusion sim.markers.zarr --split split.json --preset paper_main \
        --base sd-turbo --clip clip-vit-base-patch32 --vgg vgg16-397923af.pth --lpips vgg.pth \
        --marker-vae runs/marker-vae --out runs/m2m-sim
    python -m learning train-diffusion real.markers.zarr ... --from runs/m2m-sim --out runs/m2m-real

The paper trains on all pairs of simulated patterns, then on each group of real sensors. To use N
devices, run the same commands as `torchrun --nproc-per-node N -m learning ...`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from learning.errors import LearningError
from learning.training.checkpoint import load_weights
from learning.training.optim import set_rate
from learning.training.run import accelerator as launched
from learning.training.run import batch as sampled
from learning.training.run import generator as chance
from learning.translation.diffusion.data import ImagePairs, unit
from learning.translation.diffusion.losses import (
    Batch,
    ClipFeatures,
    DiscriminatorHeads,
    Judges,
    Side,
    merged,
    two_pass,
)
from learning.translation.diffusion.network import MarkerToMarker, Posterior, build
from learning.translation.diffusion.settings import TranslatorSettings
from learning.translation.diffusion.weights import (
    PerceptualDistance,
    read_clip,
    read_perceptual,
    read_unet,
    read_vae,
)

if TYPE_CHECKING:
    from accelerate import Accelerator

    from learning.training.run import RunFolder

_AT_ONCE = 16  # images encoded or evaluated at once


@dataclass(frozen=True, slots=True, eq=False)
class Pretrained:
    """The published networks that training starts from."""

    unet: Any
    """SD-Turbo's UNet."""
    vae: Any
    """SD-Turbo's autoencoder."""
    clip: Any = None
    """CLIP's image encoder; None if the adversary's weight is 0."""
    perceptual: PerceptualDistance | None = None
    """LPIPS; None if its weight is 0."""


def read_pretrained(settings: TranslatorSettings) -> Pretrained:
    """Load the networks that a training needs from the user's files.

    Raises:
        LearningError: A file is missing; the message names the model to download.
    """
    weights, losses = settings.weights, settings.losses
    return Pretrained(
        read_unet(weights.base),
        read_vae(weights.base),
        read_clip(weights.clip) if losses.adversarial else None,
        read_perceptual(weights.vgg, weights.lpips) if losses.perceptual else None,
    )


def train(
    pairs: ImagePairs,
    pretrained: Pretrained,
    settings: TranslatorSettings,
    *,
    validation: ImagePairs | None = None,
    vae_adapter: Mapping[str, torch.Tensor] | None = None,
    start_from: Mapping[str, torch.Tensor] | None = None,
    run: RunFolder | None = None,
    accelerator: Accelerator | None = None,
    stopping: Callable[[], bool] = lambda: False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> MarkerToMarker:
    """Train a network and return it; with a run folder, resume from its latest checkpoint.

    Args:
        pairs: Training pairs; copied to the device.
        pretrained: Networks to start from. UNet and autoencoder become part of the result.
        settings: Settings of the training.
        validation: Validation pairs; None: no validation.
        vae_adapter: Adapter of the marker autoencoder, for encoder, decoder and reference.
        start_from: State of a trained network with the same settings.
        run: Folder for checkpoints and logs; None: nothing is written.
        accelerator: Devices and precision; None: from the settings.
        stopping: Returns True to save and stop after the current step.
        progress: Called with the number of steps done and the total.

    Raises:
        LearningError: There are no pairs, weights do not fit, or a loss is not finite.
    """
    if not len(pairs):
        raise LearningError("pairs: found none; allowed: one or more")
    runs_on = accelerator or launched(settings.launch)
    device, rank, ranks = runs_on.device, runs_on.process_index, runs_on.num_processes

    # Data: all on the device.
    pairs = pairs.to(device)
    validation = None if validation is None else validation.to(device)

    # Models.
    perceptual, features, heads = _judges(pretrained, settings, device)
    network = build(pretrained.unet, pretrained.vae, settings, vae_adapter=vae_adapter)
    if start_from is not None:
        load_weights(network, start_from, "start_from")
    network.to(device).train()

    # Optimisers, wrapped for the devices; generator and discriminator have separate ones.
    own = settings.optimiser
    wrapped, optimiser = runs_on.prepare(network, own.of(network.learning().values()))
    generator, critic = Side(wrapped, optimiser, own.clip_norm), None
    models: dict[str, nn.Module] = {"model": network}
    states: dict[str, Any] = {"generator": optimiser}
    if heads is not None:
        wrapped, optimiser = runs_on.prepare(heads, own.of(heads.parameters()))
        critic = Side(wrapped, optimiser, own.clip_norm)
        models["discriminator"], states["discriminator"] = heads, optimiser
    if runs_on.scaler is not None:
        states["scaler"] = runs_on.scaler
    judges = Judges(settings.losses, perceptual, features, critic)

    # Loop. Random numbers depend only on seed, step and process, so a resumed run is identical.
    done = 0 if run is None else run.restore(models, states)
    references = encoded_references(network, pairs.references, runs_on)
    for step in range(done, settings.steps):
        rate = own.rate.at(step)
        for side in filter(None, (generator, critic)):
            set_rate(side.optimiser, rate)
        numbers = range(step * settings.accumulation, (step + 1) * settings.accumulation)
        batches = [_batch(pairs, references, settings, each, rank, ranks) for each in numbers]
        if settings.two_pass:
            losses = two_pass(batches[0], generator, judges, runs_on)
        else:
            losses = merged(batches, generator, judges, runs_on)
        done = step + 1
        progress(done, settings.steps)
        if done % settings.log_every == 0 or done in (1, settings.steps):
            message = {f"train/{name}": float(loss) for name, loss in losses.items()}
            _require_finite(message, done)
            if run is not None:
                run.log(done, {"train/rate": rate, **message})
        if run is None:
            continue

        # Evaluation and checkpoints.
        stop, last = stopping(), done == settings.steps
        measured: dict[str, float] = {}
        if validation is not None and (done % settings.validate_every == 0 or last):
            measured = evaluate(network, validation, settings, runs_on)
            run.log(done, measured)
        if done % settings.checkpoint_every == 0 or last or stop or measured:
            run.save(done, models, states, score=measured.get("validation/square"))
        if last:
            run.finish(done, {"model": network}, score=measured.get("validation/square"))
        if stop:
            break
    return network.eval()


@torch.no_grad()
def evaluate(
    network: MarkerToMarker, pairs: ImagePairs, settings: TranslatorSettings, runs_on: Accelerator
) -> dict[str, float]:
    """Return a network's mean squared error on pairs (images in [0, 1]) and the Dice of masks."""
    count = min(settings.validated, len(pairs))
    # Evenly spread over all pairs, the same ones each time.
    chosen = torch.linspace(0, len(pairs) - 1, count, device=pairs.source.device).round().long()
    references = encoded_references(network, pairs.references, runs_on)
    square, both, marked = 0.0, 0.0, 0.0
    for first in range(0, count, _AT_ONCE):
        part = pairs.rows(chosen[first : first + _AT_ONCE])
        target, source = _latents(part, references, settings.source_reference, noise=None)
        with runs_on.autocast():
            made = network(part.sources(), target, source)
        grey = network.grey(made).float() / 255
        true = part.targets()[:, 0]
        square += float(((grey - true) ** 2).mean(dim=(1, 2)).sum())
        ours, theirs = grey > 0.5, true > 0.5
        both += float((ours & theirs).sum())
        marked += float(ours.sum() + theirs.sum())
    return {
        "validation/square": square / count,
        "validation/dice": 2 * both / marked if marked else 1.0,
    }


def encoded_references(
    network: MarkerToMarker, references: torch.Tensor, runs_on: Accelerator
) -> Posterior:
    """Return the posteriors of untouched images (K, h, w) uint8 by the frozen encoder."""
    with runs_on.autocast():
        parts = [
            network.reference_posterior(unit(part)) for part in torch.split(references, _AT_ONCE)
        ]
    return Posterior(
        torch.cat([part.mean for part in parts]), torch.cat([part.deviation for part in parts])
    )


def _judges(
    pretrained: Pretrained, settings: TranslatorSettings, device: torch.device
) -> tuple[PerceptualDistance | None, ClipFeatures | None, DiscriminatorHeads | None]:
    perceptual, features, heads = None, None, None
    if settings.losses.perceptual:
        if pretrained.perceptual is None:
            raise LearningError("losses.perceptual: found one; it needs LPIPS, or 0")
        perceptual = pretrained.perceptual.to(device)
    if settings.losses.adversarial:
        if pretrained.clip is None:
            raise LearningError("losses.adversarial: found one; it needs CLIP, or 0")
        features = ClipFeatures(pretrained.clip).to(device)
        clip = pretrained.clip.config
        with torch.random.fork_rng():
            torch.manual_seed(settings.seed)
            heads = DiscriminatorHeads(clip.hidden_size, clip.projection_dim).to(device)
    return perceptual, features, heads


def _batch(
    pairs: ImagePairs,
    references: Posterior,
    settings: TranslatorSettings,
    number: int,
    rank: int,
    ranks: int,
) -> Batch:
    """Return one batch; random numbers depend only on seed, number and rank."""
    device = pairs.source.device
    index = sampled(settings.seed, number, settings.batch, len(pairs), rank=rank, ranks=ranks)
    chosen = pairs.rows(torch.from_numpy(index).to(device))
    generator = torch.Generator(device)
    generator.manual_seed(int(chance(settings.seed, "noise", number, rank).integers(2**62)))
    noise = None
    if settings.sample_latents:
        shape = (3, settings.batch, *references.mean.shape[1:])
        noise = torch.randn(shape, generator=generator, device=device)
    target, source = _latents(
        chosen, references, settings.source_reference, None if noise is None else noise[1:]
    )
    own = None if noise is None else noise[0]
    return Batch(chosen.sources(), chosen.targets(), target, source, own, generator)


def _latents(
    pairs: ImagePairs, references: Posterior, source_reference: bool, noise: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return the latents of the untouched targets, and of the sources if they are an input."""
    drawn = (None, None) if noise is None else (noise[0], noise[1])
    target = references.rows(pairs.reference[pairs.target]).at(drawn[0])
    if not source_reference:
        return target, None
    return target, references.rows(pairs.reference[pairs.source]).at(drawn[1])


def _require_finite(losses: Mapping[str, float], step: int) -> None:
    for name, loss in losses.items():
        if not math.isfinite(loss):
            raise LearningError(f"{name}: found {loss} on step {step}; allowed: finite")
