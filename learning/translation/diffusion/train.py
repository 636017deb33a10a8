r"""Training of the diffusion translator on location pairs, from settings to command.

    tactile train diffusion sim.markers.zarr --preset paper_main --out runs/m2m-sim \
        --base sd-turbo --clip clip-vit-base-patch32 --vgg vgg16-397923af.pth --lpips vgg.pth
    tactile train diffusion real.markers.zarr ... --from runs/m2m-sim --out runs/m2m-real

The paper trains a marker VAE (`train_vae`), then the translator on all pairs of simulated patterns,
then on each group of real sensors. To use N devices, run the same commands as
`torchrun --nproc-per-node N -m tactile ...`.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.nn import functional

from learning.config import read_settings, require
from learning.data.images import unit
from learning.data.pairs import PairedFrames, paired_rows, read_paired
from learning.data.presses import read_frames_of
from learning.data.splits import Role, Split
from learning.errors import LearningError
from learning.train_command import open_data, run_training
from learning.training.checkpoint import load_weights, read_model_folder
from learning.training.optim import set_rate
from learning.training.run import TrainingSession, accelerator
from learning.training.run import batch as sampled
from learning.training.run import generator as chance
from learning.translation.diffusion.discriminator import (
    ClipFeatures,
    DiscriminatorHeads,
    augment,
    multilevel_sigmoid,
)
from learning.translation.diffusion.network import (
    KIND,
    DiffusionNetworkSettings,
    LatentPosterior,
    MarkerToMarker,
    build,
    load_vae_adapter,
    native,
    vae_adapter_of,
)
from learning.translation.diffusion.train_vae import MarkerVaeSettings, Optimiser, marker_vae_of
from learning.translation.diffusion.weights import (
    BASE,
    PerceptualDistance,
    fingerprint,
    read_clip,
    read_perceptual,
    read_unet,
    read_vae,
    require_base,
    require_base_folder,
)
from recorder import MarkerArchive
from recorder.archive import archive_fingerprint

if TYPE_CHECKING:
    from accelerate import Accelerator

# Presets `paper_main` and `paper_supplement` follow the paper's two documents, `authors_code` the
# published scripts, and `ours` contains our own choices.
PRESETS = Path(__file__).parent / "presets"

_AT_ONCE = 16  # images encoded or evaluated at once
# Names in the log of the speed since the last line, and of the largest memory until now.
IMAGES_PER_S, MEMORY_GIB = "images_per_s", "memory_gib"


@dataclass(frozen=True, slots=True)
class DiffusionLossWeights:
    """Weights in the translator's loss (the paper, eq. 5)."""

    adversarial: float = 0.5
    """Multilevel sigmoid loss of the vision-aided discriminator."""
    perceptual: float = 5.0
    """LPIPS on VGG16."""
    square: float = 1.0
    """Mean squared error of images in the network's input range."""

    def __post_init__(self) -> None:
        require(self, "adversarial", "perceptual", "square", least=0)
        if self.perceptual == self.square == 0:
            raise LearningError("losses: found no reconstruction; allowed: perceptual or square")


@dataclass(frozen=True, kw_only=True)
class TranslatorSettings(MarkerVaeSettings, DiffusionNetworkSettings):
    """A diffusion translator and its training, with that of its marker VAE."""

    optimiser: Optimiser
    """Settings of each optimiser; the discriminator has its own."""
    losses: DiffusionLossWeights = field(default_factory=DiffusionLossWeights)
    sample_latents: bool = True
    """True if training samples latents from the posterior; inference uses its mean."""
    two_pass: bool = False
    """True for separate passes and steps for reconstruction and adversary (authors' code); False
    for one pass and one step."""
    steps: int = 100_000
    batch: int = 16
    """Batch size on one device, before accumulation."""
    accumulation: int = 1
    """Number of batches accumulated per step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self, "steps", "batch", "accumulation", least=1)
        if self.two_pass and self.accumulation != 1:
            raise LearningError("accumulation: found more than 1; two_pass allows 1")


@dataclass(frozen=True, slots=True, eq=False)
class Pretrained:
    """The published networks that training starts from."""

    unet: Any
    """SD-Turbo's UNet."""
    vae: Any
    """SD-Turbo's autoencoder."""
    clip: Any = None
    """CLIP's image encoder; None if the adversary's weight is 0."""
    perceptual: Any = None
    """LPIPS, a `PerceptualDistance`; None if its weight is 0."""


def read_pretrained(settings: TranslatorSettings) -> Pretrained:
    """Load the networks that a training needs from the user's files."""
    weights, losses = settings.weights, settings.losses
    return Pretrained(
        read_unet(weights.base),
        read_vae(weights.base),
        read_clip(weights.clip) if losses.adversarial else None,
        read_perceptual(weights.vgg, weights.lpips) if losses.perceptual else None,
    )


# One step of generator and discriminator, in two variants.
#
# `merged` evaluates the generator once: reconstruction and adversary share a backward pass and an
# optimiser step. `two_pass` follows the authors' code: a pass and a step for reconstruction,
# another for the adversary, and two steps of the discriminator.


@dataclass(frozen=True, slots=True, eq=False)
class TranslationBatch:
    """Inputs and true outputs of the generator."""

    source: torch.Tensor
    """Source images (n, 1, h, w) in [0, 1]."""
    target: torch.Tensor
    """Target images, likewise."""
    target_reference: torch.Tensor
    """Latents of the target's reference."""
    source_reference: torch.Tensor | None
    """Latents of the source's reference, if they are an input."""
    noise: torch.Tensor | None
    """Standard normal noise of a latent's shape; None: use the posterior's mean."""
    generator: torch.Generator
    """Random generator of augmentation."""


@dataclass(frozen=True, slots=True, eq=False)
class Trainable:
    """A trainable network with its optimiser."""

    network: nn.Module
    """The network, wrapped for distributed training on several devices."""
    optimiser: torch.optim.Optimizer
    """Optimiser of its trainable parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class Adversary:
    """The discriminator."""

    features: ClipFeatures
    heads: Trainable

    def augmented_features(
        self, images: torch.Tensor, batch: TranslationBatch
    ) -> list[torch.Tensor]:
        """Return the features of augmented images (n, 3, h, w)."""
        features: list[torch.Tensor] = self.features(augment(images, batch.generator))
        return features


@dataclass(frozen=True, slots=True, eq=False)
class TrainingStep:
    """One step of generator and discriminator."""

    runs_on: Accelerator
    losses: DiffusionLossWeights
    clip_norm: float
    """Gradient norm above which gradients are clipped; 0: no clipping."""
    generator: Trainable
    perceptual: PerceptualDistance | None
    """LPIPS; None if its weight is 0."""
    adversary: Adversary | None
    """None if its weight is 0."""

    def merged(self, batches: Sequence[TranslationBatch]) -> dict[str, torch.Tensor]:
        """Train one step on its batches; return the mean of each unweighted loss."""
        fraction = 1 / len(batches)
        reported: list[dict[str, torch.Tensor]] = []
        images = []
        for number, batch in enumerate(batches):
            with self._synchronised(self.generator, number == len(batches) - 1):
                generated = self._generated(batch)
                parts = self._reconstruction(generated, batch)
                if self.adversary is not None:
                    parts["adversarial"] = self.fooling(generated, batch, self.adversary)
                self.runs_on.backward(self._weighted(parts) * fraction)
            reported.append({name: part.detach() for name, part in parts.items()})
            images.append(generated.detach())
        self._advance(self.generator)
        if self.adversary is not None:
            heads = self.adversary.heads
            for number, (batch, generated) in enumerate(zip(batches, images, strict=True)):
                # One pass for both, since every pass updates the spectral norms.
                both = torch.cat((self._true(batch), generated))
                with self._synchronised(heads, number == len(batches) - 1):
                    with torch.no_grad():
                        features = self.adversary.augmented_features(both, batch)
                    logits = (level.chunk(2) for level in heads.network(features))
                    true, fake = zip(*logits, strict=True)
                    loss = multilevel_sigmoid(true, real=True)
                    loss = loss + multilevel_sigmoid(fake, real=False)
                    self.runs_on.backward(loss * self.losses.adversarial * fraction)
                reported[number]["discriminator"] = loss.detach()
            self._advance(heads)
        return {name: torch.stack([each[name] for each in reported]).mean() for name in reported[0]}

    def two_pass(self, batch: TranslationBatch) -> dict[str, torch.Tensor]:
        """Train one step on one batch as the authors' code does; return the unweighted losses."""
        parts = self._reconstruction(self._generated(batch), batch)
        self.runs_on.backward(self._weighted(parts))
        self._advance(self.generator)
        if self.adversary is not None:
            generated = self._generated(batch)
            parts["adversarial"] = self.fooling(generated, batch, self.adversary)
            self.runs_on.backward(parts["adversarial"] * self.losses.adversarial)
            self._advance(self.generator)
            heads, heads_losses = self.adversary.heads, []
            for images, real in ((self._true(batch), True), (generated.detach(), False)):
                with torch.no_grad():
                    features = self.adversary.augmented_features(images, batch)
                heads_losses.append(multilevel_sigmoid(heads.network(features), real=real))
                self.runs_on.backward(heads_losses[-1] * self.losses.adversarial)
                self._advance(heads)
            parts["discriminator"] = heads_losses[0] + heads_losses[1]
        return {name: part.detach() for name, part in parts.items()}

    def _generated(self, batch: TranslationBatch) -> torch.Tensor:
        generated: torch.Tensor = self.generator.network(
            batch.source, batch.target_reference, batch.source_reference, batch.noise
        )
        return generated

    def _true(self, batch: TranslationBatch) -> torch.Tensor:
        network: MarkerToMarker = self.runs_on.unwrap_model(self.generator.network)
        return native(batch.target, network.pixel_range)

    def _reconstruction(
        self, generated: torch.Tensor, batch: TranslationBatch
    ) -> dict[str, torch.Tensor]:
        true = self._true(batch)
        parts = {"square": functional.mse_loss(generated, true)}
        if self.perceptual is not None:
            parts["perceptual"] = self.perceptual(generated, true).mean()
        return parts

    def _weighted(self, parts: dict[str, torch.Tensor]) -> torch.Tensor:
        weighted = (getattr(self.losses, name) * part for name, part in parts.items())
        return sum(weighted, torch.zeros((), device=parts["square"].device))

    def fooling(
        self, generated: torch.Tensor, batch: TranslationBatch, adversary: Adversary
    ) -> torch.Tensor:
        """Return the generator's adversarial loss, with frozen heads."""
        # Unwrapped, so that the generator's backward pass does not synchronise the heads.
        heads = self.runs_on.unwrap_model(adversary.heads.network).requires_grad_(False)
        try:
            return multilevel_sigmoid(
                heads(adversary.augmented_features(generated, batch)), real=True
            )
        finally:
            heads.requires_grad_(True)

    def _synchronised(self, trainable: Trainable, last: bool) -> Any:
        """Synchronise gradients between devices only on the last batch of a step."""
        return nullcontext() if last else self.runs_on.no_sync(trainable.network)

    def _advance(self, trainable: Trainable) -> None:
        if self.clip_norm:
            learning = [
                each for group in trainable.optimiser.param_groups for each in group["params"]
            ]
            self.runs_on.clip_grad_norm_(learning, self.clip_norm)
        trainable.optimiser.step()
        trainable.optimiser.zero_grad()


def train(
    pairs: PairedFrames,
    pretrained: Pretrained,
    settings: TranslatorSettings,
    validation: PairedFrames | None = None,
    session: TrainingSession | None = None,
    *,
    vae_adapter: Mapping[str, torch.Tensor] | None = None,
    start_from: Mapping[str, torch.Tensor] | None = None,
) -> MarkerToMarker:
    """Train a network on pairs, which are copied to the device, and return it.

    Pretrained UNet and autoencoder become part of the result. `vae_adapter` is the adapter of the
    marker VAE, for encoder, decoder and reference; `start_from` is the state of a trained network
    with the same settings. Without a session the training is in memory, on the device of the
    settings.
    """
    if not len(pairs.pairs):
        raise LearningError("pairs: found none; allowed: one or more")
    session = session or TrainingSession(accelerator(settings.launch))
    run, runs_on, device = session.run, session.accelerator, session.device
    rank, ranks = runs_on.process_index, runs_on.num_processes

    # Data: all on the device.
    pairs = pairs.to(device)
    validation = None if validation is None else validation.to(device)

    # Models, and an optimiser of its own for generator and discriminator, wrapped for the devices.
    own, losses = settings.optimiser, settings.losses
    network = build(pretrained.unet, pretrained.vae, settings, vae_adapter=vae_adapter)
    if start_from is not None:
        load_weights(network, start_from, "start_from")
    network.to(device).train()
    wrapped, optimiser = runs_on.prepare(network, own.of(network.learning().values()))
    trainables, adversary = [Trainable(wrapped, optimiser)], None
    models: dict[str, nn.Module] = {"model": network}
    states: dict[str, Any] = {"generator": optimiser}
    if losses.adversarial:
        clip = pretrained.clip.config
        with torch.random.fork_rng():
            torch.manual_seed(settings.seed)
            heads = DiscriminatorHeads(clip.hidden_size, clip.projection_dim).to(device)
        wrapped, optimiser = runs_on.prepare(heads, own.of(heads.parameters()))
        trainables.append(Trainable(wrapped, optimiser))
        adversary = Adversary(ClipFeatures(pretrained.clip).to(device), trainables[1])
        models["discriminator"], states["discriminator"] = heads, optimiser
    if runs_on.scaler is not None:
        states["scaler"] = runs_on.scaler
    perceptual = pretrained.perceptual.to(device) if losses.perceptual else None
    trained = TrainingStep(runs_on, losses, own.clip_norm, trainables[0], perceptual, adversary)

    # Loop. Random numbers depend only on seed, step and process, so a resumed run is identical.
    done, score = run.restore(models, states), None
    references = encoded_references(network, pairs.references, runs_on)
    logged, since = done, time.perf_counter()
    for step in range(done, settings.steps):
        rate = own.rate.at(step)
        for trainable in trainables:
            set_rate(trainable.optimiser, rate)
        numbers = range(step * settings.accumulation, (step + 1) * settings.accumulation)
        batches = [_batch(pairs, references, settings, each, rank, ranks) for each in numbers]
        reported = trained.two_pass(batches[0]) if settings.two_pass else trained.merged(batches)

        # Log, validation and checkpoint
        done = step + 1
        last, stop, score = done == settings.steps, session.passed(done, settings.steps), None
        if last or done == 1 or done % settings.log_every == 0:
            message = {f"train/{name}": float(loss) for name, loss in reported.items()}
            for name, loss in message.items():
                if not math.isfinite(loss):
                    raise LearningError(f"{name}: found {loss} on step {done}; allowed: finite")
            images = (done - logged) * settings.batch * settings.accumulation * ranks
            speed = images / (time.perf_counter() - since)
            cost = {IMAGES_PER_S: speed, MEMORY_GIB: _peak_memory(device)}
            run.log(done, {"train/rate": rate, **message, **cost})
            logged, since = done, time.perf_counter()
        if validation is not None and (last or done % settings.validate_every == 0):
            measured = evaluate(network, validation, settings, runs_on)
            score = measured["validation/square"]
            run.log(done, measured)
        if last or stop or score is not None or done % settings.checkpoint_every == 0:
            run.save(done, models, states, score=score)
        if stop:
            break
    if done == settings.steps:
        run.finish(done, {"model": network}, score=score)
    return network.eval()


def _peak_memory(device: torch.device) -> float:
    """Return the largest memory [GiB] that a GPU, or else this process, has had in use."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 2**30
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


@torch.no_grad()
def evaluate(
    network: MarkerToMarker, pairs: PairedFrames, settings: TranslatorSettings, runs_on: Accelerator
) -> dict[str, float]:
    """Return a network's mean squared error on pairs (images in [0, 1]) and the Dice of masks."""
    count = min(settings.validated, len(pairs.pairs))
    # Evenly spread over all pairs, the same ones each time.
    chosen = torch.linspace(0, len(pairs.pairs) - 1, count, device=pairs.device).round().long()
    references = encoded_references(network, pairs.references, runs_on)
    square, both, marked = 0.0, 0.0, 0.0
    for first in range(0, count, _AT_ONCE):
        part = pairs.of_pairs(chosen[first : first + _AT_ONCE])
        target, source = _latents(part, references, settings.source_reference)
        with runs_on.autocast():
            generated = network(part.unit_images(part.pairs[:, 0]), target, source)
        grey = network.grey(generated).float() / 255
        true = part.unit_images(part.pairs[:, 1])[:, 0]
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
) -> LatentPosterior:
    """Return the posteriors of images without contact (K, h, w) uint8 by the frozen encoder."""
    with runs_on.autocast():
        parts = [
            network.reference_posterior(unit(part)) for part in torch.split(references, _AT_ONCE)
        ]
    return LatentPosterior(
        torch.cat([part.mean for part in parts]), torch.cat([part.deviation for part in parts])
    )


def _batch(
    pairs: PairedFrames,
    references: LatentPosterior,
    settings: TranslatorSettings,
    number: int,
    rank: int,
    ranks: int,
) -> TranslationBatch:
    """Return one batch; random numbers depend only on seed, number and rank."""
    device = pairs.device
    count = len(pairs.pairs)
    index = sampled(settings.seed, number, settings.batch, count, rank=rank, ranks=ranks)
    chosen = pairs.of_pairs(torch.from_numpy(index).to(device))
    generator = torch.Generator(device)
    generator.manual_seed(int(chance(settings.seed, "noise", number, rank).integers(2**62)))
    noise: Sequence[torch.Tensor | None] = (None, None, None)
    if settings.sample_latents:
        shape = (3, settings.batch, *references.mean.shape[1:])
        noise = torch.randn(shape, generator=generator, device=device).unbind()
    target, source = _latents(chosen, references, settings.source_reference, noise[1:])
    images = [chosen.unit_images(rows) for rows in chosen.pairs.unbind(dim=1)]
    return TranslationBatch(images[0], images[1], target, source, noise[0], generator)


def _latents(
    pairs: PairedFrames,
    references: LatentPosterior,
    source_reference: bool,
    noise: Sequence[torch.Tensor | None] = (None, None),
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Return the latents of the targets' references, and of the sources if they are an input."""
    own, other = pairs.reference[pairs.pairs].unbind(dim=1)
    target = references.rows(other).at(noise[0])
    return target, references.rows(own).at(noise[1]) if source_reference else None


def run(options: argparse.Namespace) -> int:
    """Train as the options of `train diffusion` say; return the exit code."""
    if options.marker_vae is not None and options.start_from is not None:
        raise LearningError("--marker-vae, --from: found both; allowed: one, or neither")
    overrides = [
        f"weights.{name}={json.dumps(getattr(options, name))}"
        for name in ("base", "clip", "vgg", "lpips")
        if getattr(options, name) is not None
    ]
    settings = read_settings(
        TranslatorSettings, PRESETS, options.preset, [*options.set, *overrides]
    )
    train_in(
        options.out,
        *open_data(options),
        settings,
        options.sensors,
        marker_vae=options.marker_vae,
        start_from=options.start_from,
        pairing=options.pairing,
    )
    return 0


def train_in(
    out: Path,
    archive: MarkerArchive,
    split: Split,
    settings: TranslatorSettings,
    sensors: Sequence[str] | None = None,
    *,
    marker_vae: Path | None = None,
    start_from: Path | None = None,
    pairing: str = "supplement",
) -> None:
    """Train the paper's translator in a folder.

    It starts from a translator, or from a marker VAE, which is trained first if neither is given.
    `pairing` is the rule for pairing frames of a press. Without `sensors`, it learns from all that
    the split does not hold out.
    """
    sensors = [*(sensors or split.trained_sensors(archive))]
    require_base_folder(settings.weights.base)
    base = fingerprint(settings.weights.base)
    roles: tuple[Role, ...] = ("train", "validation")
    rows = [paired_rows(archive, split, sensors, role, preset=pairing) for role in roles]
    frames = " ".join(["archive", archive_fingerprint(archive), split.fingerprint, *sensors])
    vae_adapter, state, begun = None, None, ""
    if marker_vae is not None:
        vae_adapter = load_vae_adapter(marker_vae, base)
        begun = read_model_folder(marker_vae).hash()
    if start_from is not None:
        before = read_model_folder(start_from, KIND)
        require_base(before, base)
        state, begun = before.weights(), before.hash()
        vae_adapter = vae_adapter_of(state)

    def read_images(session: TrainingSession) -> list[torch.Tensor]:
        """Return the frames of training and validation, for the marker VAE."""
        chosen = [archive[name] for name in sensors]
        every = [[split.rows(each.table, role) for each in chosen] for role in roles]
        return [read_frames_of(chosen, each, session.device, session.reading) for each in every]

    def train_it(session: TrainingSession) -> None:
        adapter = vae_adapter
        if not begun and settings.marker_vae.steps:
            adapter = marker_vae_of(settings, frames, partial(read_images, session), session)
            if adapter is None:
                return
            session = replace(session, accelerator=accelerator(settings.launch))
        pretrained = read_pretrained(settings)
        pairs, validation = (
            read_paired(
                archive, each, preset=pairing, device=session.device, progress=session.reading
            )
            for each in rows
        )
        if not len(pairs.pairs):
            raise LearningError(
                f"{archive.name}: {', '.join(sensors)} have no location pairs with role train; "
                "allowed: sensors that were pressed at the same places"
            )
        print(f"{len(pairs.pairs):,} pairs of {', '.join(sensors)}", file=sys.stderr)
        with session.stop:
            train(
                pairs,
                pretrained,
                settings,
                validation if len(validation.pairs) else None,
                session,
                vae_adapter=adapter,
                start_from=state,
            )

    data = [frames, pairing, base, begun]
    run_training(out, KIND, settings, data, train_it, split=split, metadata={BASE: base})
