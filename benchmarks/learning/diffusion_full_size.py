"""Memory, speed and decreasing loss of the full-size networks with random weights.

    python -m benchmarks diffusion-full-size full-size.json

Everything except the values of the weights is as in training on published weights: SD-2.1-base's
UNet and autoencoder (the same as SD-Turbo's), CLIP ViT-B/32 and VGG16. Networks with random weights
learn nothing useful; a loss that falls on a few images shows that gradients pass through all parts.
"""

from __future__ import annotations

import argparse
import gc
import json
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from learning.config import read_settings, settings_to_dict
from learning.data.images import LATTICE, SIDE, enlarge_images, inverse
from learning.data.pairs import PairedFrames
from learning.data.synthetic import pixel_grid, sample_patterns
from learning.errors import LearningError
from learning.training.run import METRICS, RunFolder, TrainingSession, described, generator
from learning.training.run import accelerator as launched
from learning.translation.diffusion.network import KIND, MarkerToMarker, fuse
from learning.translation.diffusion.train import (
    PRESETS,
    DiffusionLossWeights,
    Pretrained,
    TranslatorSettings,
    train,
)
from learning.translation.diffusion.translator import DiffusionTranslator
from learning.translation.diffusion.weights import WIDTHS, PerceptualDistance, vendor
from recorder.command_line.options import numbers
from recorder.markers import HEIGHT, WIDTH
from recorder.progress import ItemProgress
from recorder.store.files import replace_file

if TYPE_CHECKING:
    from accelerate import Accelerator

# Training steps for each batch size.
STEPS = 50
# Learning rate: high, because random weights have no learned content to lose.
RATE = 1e-3
# Pairs that are trained on repeatedly.
SAME = 4
# Warm-up steps that are not timed.
WARM = 5
# Largest strain at the centre of a contact.
MOST_OUTWARD = 0.35
# Number of frames whose translation is timed.
TRANSLATED = 64

# Stable Diffusion 2.1's UNet (865.9 M parameters).
UNET = {
    "sample_size": 64,
    "in_channels": 4,
    "out_channels": 4,
    "down_block_types": ["CrossAttnDownBlock2D"] * 3 + ["DownBlock2D"],
    "up_block_types": ["UpBlock2D"] + ["CrossAttnUpBlock2D"] * 3,
    "block_out_channels": [320, 640, 1280, 1280],
    "layers_per_block": 2,
    "attention_head_dim": [5, 10, 20, 20],
    "cross_attention_dim": 1024,
    "use_linear_projection": True,
    "norm_eps": 1e-5,
}
# Its autoencoder (83.7 M parameters).
VAE = {
    "in_channels": 3,
    "out_channels": 3,
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
    "block_out_channels": [128, 256, 512, 512],
    "layers_per_block": 2,
    "latent_channels": 4,
    "sample_size": 768,
    "scaling_factor": 0.18215,
}
# Image encoder of CLIP ViT-B/32.
CLIP = {
    "hidden_size": 768,
    "intermediate_size": 3072,
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "image_size": 224,
    "patch_size": 32,
    "projection_dim": 512,
}


@dataclass(frozen=True, slots=True)
class Measured:
    """Measurements for one batch size, with all losses."""

    batch: int
    """Pairs per step."""
    training_images_per_s: float
    """Pairs trained on per second."""
    inference_images_per_s: float
    """Frames translated per second, from mask to mask, in batches of this size."""
    memory_gib: float | None
    """Peak memory of the device during training; None on a CPU."""
    learning: int
    """Number of trainable parameters, without the discriminator's."""
    whole: int
    """Total number of parameters, without those of the networks that compute losses."""


def random_pretrained(
    unet: dict[str, Any],
    vae: dict[str, Any],
    clip: dict[str, Any],
    widths: Sequence[int],
    device: torch.device | str = "cpu",
) -> Pretrained:
    """Return networks of the given configurations with random weights, the same ones each time."""
    diffusers, transformers = vendor("diffusers"), vendor("transformers")
    with torch.random.fork_rng(), torch.device(device):
        torch.manual_seed(0)
        return Pretrained(
            diffusers.UNet2DConditionModel.from_config(unet),
            diffusers.AutoencoderKL.from_config(vae),
            transformers.CLIPVisionModelWithProjection(transformers.CLIPVisionConfig(**clip)),
            PerceptualDistance(widths),
        )


def check(
    batches: Sequence[int],
    out: Path,
    *,
    steps: int = STEPS,
    overrides: Sequence[str] = (),
    networks: Callable[[torch.device], Pretrained] | None = None,
    side: int = SIDE,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Measure training and translation at full size, and write the result to a file as JSON.

    Args:
        batches: Batch sizes, one measurement each.
        out: The file; it is updated after each measurement.
        steps: Number of steps of each training.
        overrides: Settings that override the preset `ours` and those of this check.
        networks: Creates the networks on a device; None: the full-size ones.
        side: Side of the training images [px].
        progress: Called with the number of steps done and the total.

    Raises:
        LearningError: Invalid batch size or number of steps.
    """
    if not batches or min(batches) < 1 or steps <= WARM:
        raise LearningError(
            f"batches: found {list(batches)}, {steps} steps; allowed: 1 and more, above {WARM}"
        )
    own = [
        f"steps={steps}",
        f"checkpoint_every={steps}",
        "log_every=10",
        f"optimiser.rate={{kind: constant, rate: {RATE}}}",
        # The posterior of a random encoder is pure noise.
        "sample_latents=false",
    ]
    settings = read_settings(TranslatorSettings, PRESETS, "ours", [*own, *overrides])
    made = networks or _full_size
    total = steps * (len(batches) + 1)
    measured: list[dict[str, Any]] = []
    found: dict[str, Any] = {
        "device": described(launched(settings.launch)),
        "torch": torch.__version__,
        "diffusers": vendor("diffusers").__version__,
        "python": platform.python_version(),
        "settings": settings_to_dict(settings),
        "measured": measured,
    }
    for number, batch in enumerate(batches):

        def advance(done: int, _: int, earlier: int = number * steps) -> None:
            progress(earlier + done, total)

        measured.append(asdict(_measured(made, replace(settings, batch=batch), side, advance)))
        replace_file(out, json.dumps(found, indent=2).encode() + b"\n")
    found["square"] = _falling(
        made,
        replace(settings, batch=SAME, losses=DiffusionLossWeights(adversarial=0, perceptual=0)),
        side,
        lambda done, _: progress(total - steps + done, total),
    )
    replace_file(out, json.dumps(found, indent=2).encode() + b"\n")
    return found


def table(found: dict[str, Any]) -> str:
    """Return the measurements as a table."""
    lines = [found["device"], "batch   training  inference   memory"]
    lines.append("        images/s   images/s      GiB")
    for row in found["measured"]:
        memory = "-" if row["memory_gib"] is None else f"{row['memory_gib']:.1f}"
        lines.append(
            f"{row['batch']:>5} {row['training_images_per_s']:>10.1f} "
            f"{row['inference_images_per_s']:>10.1f} {memory:>8}"
        )
    message = ", ".join(f"{step}: {square:.3f}" for step, square in found["square"].items())
    return "\n".join([*lines, f"mean square on {SAME} pairs, as the only loss, by step: {message}"])


def _full_size(device: torch.device) -> Pretrained:
    return random_pretrained(UNET, VAE, CLIP, WIDTHS, device)


def _random_fields(
    count: int, generator: np.random.Generator, device: torch.device
) -> torch.Tensor:
    """Return synthetic displacements (count, 2, 57, 73) [px of 640 x 480], without an archive.

    Up to three contacts push the surface outwards and drag it along, each as a Gaussian. This is
    not the deformation of a gel, but suffices to learn the appearance of deformed markers.
    """
    row, column = np.meshgrid(LATTICE.rows, LATTICE.columns, indexing="ij")
    places = torch.from_numpy(np.stack([column, row]).astype(np.float32)).to(device)
    field = torch.zeros((count, 2, *row.shape), device=device)
    for contact in range(3):
        there = (generator.random((count, 1)) < (1.0, 0.3, 0.1)[contact]).astype(float)
        centre = generator.uniform(0.1, 0.9, (count, 2)) * (WIDTH, HEIGHT)
        width = generator.uniform(40, 140, (count, 1))
        outward = there * generator.uniform(0, MOST_OUTWARD, (count, 1)) * width
        shear = there * generator.normal(0, 12, (count, 2))
        values = np.concatenate([centre, width, outward, shear], axis=1).astype(np.float32)
        value = torch.from_numpy(values).to(device)[:, :, None, None]
        away = (places - value[:, :2]) / value[:, 2:3]
        near = torch.exp(-0.5 * away.square().sum(dim=1, keepdim=True))
        far = torch.exp(-0.125 * away.square().sum(dim=1, keepdim=True))
        field = field + value[:, 3:4] * away * near + value[:, 4:] * far
    return field


def overfitted_pairs(count: int, side: int, device: torch.device) -> PairedFrames:
    """Return pairs of random patterns with equal motion, as images of a given side [px]."""
    chance = generator(0, "full-size-check")
    patterns = sample_patterns(2 * count, chance, device)
    field = _random_fields(count, chance, device)
    both = torch.cat((field, field))
    moved = patterns.draw(pixel_grid(side, device) + inverse(both, *pixel_grid(side, device)[0]))
    still = patterns.draw(pixel_grid(side, device))
    images, references = ((each[:, 0] * 255).round().to(torch.uint8) for each in (moved, still))
    every = torch.arange(2 * count, device=device)
    return PairedFrames(images, every, every, references, every.view(2, count).T)


def _measured(
    networks: Callable[[torch.device], Pretrained],
    settings: TranslatorSettings,
    side: int,
    progress: Callable[[int, int], None],
) -> Measured:
    """Train with all losses, then translate, and return the measurements."""
    # An accelerator keeps references to its models, so each training has its own.
    runs_on = launched(settings.launch)
    device = runs_on.device
    on_gpu = device.type == "cuda"
    if on_gpu:
        gc.collect()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    times: dict[int, float] = {}

    def stamp(done: int, total: int) -> None:
        if done in (WARM, total):
            times[done] = _now(device)
        progress(done, total)

    pairs = overfitted_pairs(SAME, side, device)
    session = TrainingSession(runs_on, progress=stamp)
    network = train(pairs, networks(device), settings, session=session)
    seconds = times[settings.steps] - times[WARM]
    memory = torch.cuda.max_memory_allocated(device) / 2**30 if on_gpu else None
    learning = sum(each.numel() for each in network.learning().values())
    return Measured(
        batch=settings.batch,
        training_images_per_s=settings.batch * (settings.steps - WARM) / seconds,
        memory_gib=memory,
        learning=learning,
        whole=sum(each.numel() for each in network.parameters()),
        inference_images_per_s=_translated_per_s(network, settings, runs_on),
    )


def _falling(
    networks: Callable[[torch.device], Pretrained],
    settings: TranslatorSettings,
    side: int,
    progress: Callable[[int, int], None],
) -> dict[str, float]:
    """Return the mean square by step, for a training with this loss alone."""
    runs_on = launched(settings.launch)
    with TemporaryDirectory() as folder:
        run = RunFolder.open(Path(folder) / "run", KIND, settings, "random patterns")
        pairs = overfitted_pairs(SAME, side, runs_on.device)
        made = networks(runs_on.device)
        train(pairs, made, settings, session=TrainingSession(runs_on, run, progress=progress))
        lines = map(json.loads, (run.path / METRICS).read_text().splitlines())
        return {str(line["step"]): line["train/square"] for line in lines}


def _translated_per_s(
    network: MarkerToMarker, settings: TranslatorSettings, runs_on: Accelerator
) -> float:
    """Return frames per second from masks to masks, with fused adapters as in `translate`."""
    fuse(network.unet)
    fuse(network.vae)
    lower = runs_on.device.type == "cuda" and settings.launch.mixed_precision != "no"
    translator = DiffusionTranslator(
        network,
        "random weights",
        batch=settings.batch,
        precision=torch.bfloat16 if lower else torch.float32,
    )
    frames = overfitted_pairs(SAME, SIDE, runs_on.device).images
    masks = enlarge_images(frames)
    few, many = masks[:1], masks[torch.arange(TRANSLATED) % len(masks)]
    if runs_on.device.type == "cpu":
        many = masks
    translator.translate(many[: settings.batch], few[0], few[0])
    begun = _now(runs_on.device)
    translator.translate(many, few[0], few[0])
    return len(many) / (_now(runs_on.device) - begun)


def _now(device: torch.device) -> float:
    """Return the time [s] at which the device has finished its queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.description = (
        "Measures memory, speed and decreasing loss of the full-size networks with "
        "random weights; needs a GPU, but no archive and no weights."
    )
    parser.add_argument("out", type=Path, metavar="JSON", help="file to write")
    parser.add_argument(
        "--batches",
        type=numbers(),
        default="4,8,16",
        metavar="N,...",
        help="batch sizes (%(default)s)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="override the preset `ours`",
    )


def run(options: argparse.Namespace) -> int:
    """Measure, write and print the results, and return the exit code."""
    batches = [int(count) for count in options.batches]
    with ItemProgress("steps", sys.stderr) as steps:
        found = check(batches, options.out, overrides=options.set, progress=steps)
    print(table(found))
    print(f"{options.out}: written")
    return 0
