r"""Training of the marker autoencoder, from settings to command: SD-Turbo's with an adapter.

    tactile train marker-vae sim.markers.zarr --split split.json --preset paper_main \
        --base sd-turbo --out runs/marker-vae

This is the first of the paper's three stages. Its adapter initialises the translator's encoder and
decoder, which are trained further, and the reference encoder, which stays frozen.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from torch.nn import functional

from learning.archive_writer import archive_fingerprint
from learning.config import read_settings, require
from learning.data.images import unit
from learning.data.splits import Split
from learning.errors import LearningError
from learning.train_command import open_data, run_training, trained_on
from learning.training.checkpoint import ModelFolder, read_model_folder
from learning.training.optim import Constant, Cosine, set_rate
from learning.training.run import LaunchSettings, Session, accelerator, generator
from learning.training.run import batch as sampled
from learning.translation.diffusion.data import read_role_images
from learning.translation.diffusion.network import (
    VAE_ADAPTER,
    VAE_TARGETS,
    Range,
    adapter_tensors,
    add_adapter,
    is_adapter,
    keep_in_state,
    posterior,
)
from learning.translation.diffusion.weights import fingerprint, read_vae, require_base_folder
from recorder import MarkerArchive

if TYPE_CHECKING:
    from accelerate import Accelerator

# Kind of a marker autoencoder's folder.
KIND = "marker-vae"
# Name of the fact with the fingerprint of the published weights, and of the folder for them.
BASE = "base"
# Presets `paper_main` and `paper_supplement` follow the paper's two documents, `authors_code` the
# published scripts, and `ours` contains our own choices.
PRESETS = Path(__file__).parent / "presets" / "marker_vae"

_AT_ONCE = 16  # images evaluated at once


# Settings; those before the last class are the translator's as well


@dataclass(frozen=True, slots=True)
class Weights:
    """Paths of the published weights that training starts from."""

    base: str = ""
    """Folder of SD-Turbo in diffusers' layout."""
    clip: str = ""
    """Folder of CLIP ViT-B/32 in transformers' layout; read if `losses.adversarial` is not 0."""
    vgg: str = ""
    """File of torchvision's VGG16; read if `losses.perceptual` is not 0."""
    lpips: str = ""
    """File of LPIPS' linear heads for VGG; read with it."""


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
class TrainingSettings:
    """Settings that both stages of training have."""

    description: str
    """Source of the numbers."""
    optimiser: Optimiser
    """Settings of each optimiser; a discriminator has its own."""
    weights: Weights = field(default_factory=Weights)
    """Published weights that training starts from."""
    pixel_range: Range = "minus_one_one"
    """Values of black and white for the networks, which were all trained for -1 and 1."""
    whole: bool = False
    """True to train all weights, for networks without published ones, in place of adapters."""
    vae_rank: int = 4
    """Rank of the autoencoder's adapter; a translator's, if no trained one is given."""
    steps: int = 100_000
    """Steps of the optimiser."""
    batch: int = 16
    """Batch size on one device, before accumulation."""
    accumulation: int = 1
    """Number of batches accumulated per step."""
    launch: LaunchSettings = field(default_factory=LaunchSettings)
    """Devices and precision; the step to the clean latent and the losses are always float32."""
    gradient_checkpointing: bool = False
    """True to recompute activations instead of storing them: less memory, more time."""
    validated: int = 256
    """Largest number of validation images or pairs to evaluate."""
    checkpoint_every: int = 1000
    """Steps between checkpoints."""
    log_every: int = 25
    """Steps between lines in the log."""
    validate_every: int = 1000
    """Steps between validations."""
    seed: int = 0
    """Seed of everything random."""

    def __post_init__(self) -> None:
        require(self, "vae_rank", least=1, most=1024)
        require(self, "steps", "batch", "accumulation", least=1)
        require(self, "checkpoint_every", "log_every", "validate_every", least=1)


@dataclass(frozen=True, slots=True)
class MarkerVaeSettings(TrainingSettings):
    """Training settings of the marker autoencoder, the stage before the translator."""

    absolute: float = 1.0
    """Weight of the mean absolute error."""
    square: float = 1.0
    """Weight of the mean squared error."""
    divergence: float = 1e-6
    """Weight of the posterior's divergence from the normal distribution, summed over a latent."""
    decode_scaled: bool = False
    """True if the decoder takes the latent times its scaling factor, as in the authors' code. Their
    translator decodes it unscaled."""

    def __post_init__(self) -> None:
        TrainingSettings.__post_init__(self)
        require(self, "absolute", "square", "divergence", least=0)


# Network and losses


class MarkerVae(nn.Module):
    """SD-Turbo's autoencoder with an adapter, for images (n, 1, h, w) in [0, 1].

    Its state contains only the adapter, or all weights if all are trained.
    """

    def __init__(self, vae: Any, settings: MarkerVaeSettings) -> None:
        """Add the adapter, unless all weights are trained."""
        super().__init__()
        if not settings.whole:
            add_adapter(vae, VAE_ADAPTER, settings.vae_rank, VAE_TARGETS, seed=settings.seed)
        if settings.gradient_checkpointing:
            vae.enable_gradient_checkpointing()
        self.vae = vae
        self.zero_one = settings.pixel_range == "zero_one"
        self.decode_scaled = settings.decode_scaled
        if not settings.whole:
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


# Loop


def train_vae(
    images: torch.Tensor,
    vae: Any,
    settings: MarkerVaeSettings,
    validation: torch.Tensor | None = None,
    session: Session | None = None,
) -> MarkerVae:
    """Train the autoencoder and return it.

    Args:
        images: Training images of all patterns (n, h, w) uint8; copied to the device.
        vae: SD-Turbo's autoencoder; becomes part of the result.
        settings: Settings of the training.
        validation: Validation images; None: no validation.
        session: Surroundings of the training; None: in memory, on the device of the settings.

    Raises:
        LearningError: There are no images, or a loss is not finite.
    """
    if not len(images):
        raise LearningError("images: found none; allowed: one or more")
    session = session or Session(accelerator(settings.launch))
    run, runs_on, device = session.run, session.accelerator, session.device
    rank, ranks = runs_on.process_index, runs_on.num_processes
    images = images.to(device)
    validation = None if validation is None else validation.to(device)

    network = MarkerVae(vae, settings).to(device).train()
    learning = [each for each in network.parameters() if each.requires_grad]
    own = settings.optimiser
    wrapped, optimiser = runs_on.prepare(network, own.of(learning))
    states: dict[str, Any] = {"optimiser": optimiser}
    if runs_on.scaler is not None:
        states["scaler"] = runs_on.scaler

    done, score = run.restore({"model": network}, states), None
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

        # Log, validation and checkpoint
        done = step + 1
        last, stop, score = done == settings.steps, session.passed(done, settings.steps), None
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
    if done == settings.steps:
        run.finish(done, {"model": network}, score=score)
    return network.eval()


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
    chance = torch.Generator(images.device)
    chance.manual_seed(int(generator(seed, "noise", number, rank).integers(2**62)))
    config = network.vae.config
    smaller = 2 ** (len(config.block_out_channels) - 1)
    sides = (side // smaller for side in images.shape[2:])
    return torch.randn(
        (len(images), config.latent_channels, *sides), generator=chance, device=images.device
    )


# Trained models, and the command


def load_vae_adapter(folder: str | Path, base: str) -> dict[str, torch.Tensor]:
    """Return the adapter of a trained marker autoencoder from its folder.

    Args:
        folder: Run folder of the autoencoder.
        base: Fingerprint of the published weights that it will be applied to.

    Raises:
        LearningError: Not such a folder, or trained from other published weights.
    """
    found = read_model_folder(Path(folder), KIND)
    require_base(found, base)
    return vae_adapter_of(found.weights())


def vae_adapter_of(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the autoencoder's adapter in the state of a translator or of an autoencoder.

    If all weights were trained, there is no adapter, and all of the autoencoder's are returned.
    """
    own = {
        name.removeprefix("vae."): tensor
        for name, tensor in state.items()
        if name.startswith("vae.")
    }
    return {name: tensor for name, tensor in own.items() if is_adapter(name)} or own


def require_base(found: ModelFolder, base: str) -> None:
    """Reject published weights other than those the run was trained from.

    Raises:
        LearningError: The fingerprints differ.
    """
    expected = found.config.metadata.get(BASE)
    if expected != base:
        raise LearningError(
            f"{found.path}: was trained from published weights {expected}, found {base}; "
            "allowed: the same ones"
        )


def run(options: argparse.Namespace) -> int:
    """Train as the options of `train marker-vae` say; return the exit code."""
    given = [] if options.base is None else [f"weights.base={json.dumps(options.base)}"]
    settings = read_settings(MarkerVaeSettings, PRESETS, options.preset, [*options.set, *given])
    train_in(options.out, *open_data(options), settings, options.sensors, resume=options.resume)
    return 0


def train_in(
    out: Path,
    archive: MarkerArchive,
    split: Split,
    settings: MarkerVaeSettings,
    sensors: Sequence[str] | None = None,
    *,
    resume: bool,
) -> None:
    """Train a marker VAE in a folder.

    Args:
        out: Folder of the run.
        archive: Frames of the sensors.
        split: Roles of its presses.
        settings: Settings of model and training.
        sensors: Sensors to learn from; None: all that the split does not hold out.
        resume: True to continue a run that is in the folder.

    Raises:
        LearningError: Another run is in the folder, or the training was rejected.
        KeyboardInterrupt: It was stopped, after its state was saved.
    """
    sensors = trained_on(archive, split, sensors)
    require_base_folder(settings.weights.base)
    base = fingerprint(settings.weights.base)

    def train(session: Session) -> None:
        images, validation = (
            read_role_images(
                archive,
                split,
                role,
                sensors=sensors,
                device=session.device,
                progress=session.reading,
            )
            for role in ("train", "validation")
        )
        print(f"{len(images):,} images of {', '.join(sensors)}", file=sys.stderr)
        vae, held = read_vae(settings.weights.base), validation if len(validation) else None
        with session.stop:
            train_vae(images, vae, settings, held, session)

    data = ["archive", archive_fingerprint(archive), split.fingerprint, *sensors, base]
    run_training(
        out, KIND, settings, data, train, resume=resume, split=split, metadata={BASE: base}
    )
