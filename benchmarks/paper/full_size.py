"""Diffusion at the paper's size: speed and memory, with random weights.

All but the values of the weights is as in a training on published ones: SD-2.1-base's UNet and
autoencoder (the same as SD-Turbo's), CLIP ViT-B/32 and VGG16.
"""

import gc
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from benchmarks.report import Page, Run, table
from learning.config import read_settings
from learning.data.images import SIDE, enlarge_images
from learning.data.pairs import PairedFrames
from learning.training.run import TrainingSession, accelerator
from learning.translation.diffusion.network import MarkerToMarker, fuse
from learning.translation.diffusion.train import PRESETS, Pretrained, TranslatorSettings, train
from learning.translation.diffusion.translator import DiffusionTranslator
from learning.translation.diffusion.weights import WIDTHS, PerceptualDistance, vendor

# Batch sizes, steps of each training, of which the first are not timed, and frames translated.
BATCHES, STEPS, WARM, TRANSLATED = [4, 8, 16], 50, 5, 64
# Learning rate: high, because random weights have no learned content to lose.
RATE = 1e-3
# Pairs of images.
PAIRS = 4

# Where Stable Diffusion 2.1's UNet (865.9 M parameters) differs from the defaults of diffusers.
UNET: dict[str, Any] = {
    "sample_size": 64,
    "attention_head_dim": [5, 10, 20, 20],
    "cross_attention_dim": 1024,
    "use_linear_projection": True,
}
# Its autoencoder (83.7 M parameters).
VAE: dict[str, Any] = {
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
    "block_out_channels": [128, 256, 512, 512],
    "layers_per_block": 2,
    "sample_size": 768,
}
# The image encoder of CLIP ViT-B/32 is the default of transformers.
CLIP: dict[str, Any] = {}
# A few thousand weights, for a quick run: what of each configuration differs.
_SMALL: tuple[dict[str, Any], ...] = (
    {
        "block_out_channels": [8, 16, 16, 16],
        "norm_num_groups": 4,
        "layers_per_block": 1,
        "attention_head_dim": 4,
    },
    {"block_out_channels": [4, 8, 8, 8], "norm_num_groups": 2, "layers_per_block": 1},
    {"hidden_size": 16, "intermediate_size": 16, "num_attention_heads": 2, "projection_dim": 8},
)


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


def measure(run: Run) -> dict[str, Any]:
    """Train and translate with each batch size; quick: one image, small networks."""
    run.seeds, run.spread = (0,), "single run; the first steps of a training are not timed"
    networks, batches, steps, widths = [UNET, VAE, CLIP], BATCHES, STEPS, WIDTHS
    if run.quick:
        networks = [one | less for one, less in zip(networks, _SMALL, strict=True)]
        batches, steps, widths = [1], WARM + 1, (2, 2, 3, 3, 3)
    launch = run.device.split(":")[0]
    precision = "bf16" if launch == "cuda" else "no"
    own = [
        f"steps={steps}",
        f"checkpoint_every={steps}",
        f"optimiser.rate={{kind: constant, rate: {RATE}}}",
        f"launch={{device: {launch}, mixed_precision: '{precision}'}}",
        # The posterior of a random encoder is pure noise.
        "sample_latents=false",
    ]
    settings = read_settings(TranslatorSettings, PRESETS, "ours", own)
    rows = []
    for done, batch in enumerate(batches, 1):
        # An accelerator refers to its models, so each training has its own.
        runs_on = accelerator(settings.launch)
        unet, vae, clip = networks
        made = random_pretrained(unet, vae, clip, widths, runs_on.device)
        rows.append(_row(made, replace(settings, batch=batch), runs_on))
        run.progress(done / len(batches))
    return {"rows": rows}


def section(values: dict[str, Any], page: Page) -> str:
    """Return the table."""
    names = ("batch", "training [images/s]", "translation [images/s]", "memory [GiB]")
    rows = [
        [row["batch"], f"{row['training']:.1f}", translated or "-", row["memory"]]
        for row in values["rows"]
        for translated in (row["translation"] and f"{row['translation']:.1f}",)
    ]
    return f"""## Diffusion at the paper's size

Stable Diffusion 2.1's UNet and autoencoder, CLIP and VGG16, with random weights and all losses.

{table(names, rows)}"""


def random_pairs(device: torch.device) -> PairedFrames:
    """Return pairs of random images, which are trained on repeatedly."""
    chance = torch.Generator(device).manual_seed(0)
    size = (2, 2 * PAIRS, SIDE, SIDE)
    images, references = torch.randint(256, size, generator=chance, device=device).byte()
    every = torch.arange(2 * PAIRS, device=device)
    return PairedFrames(images, every, every, references, every.view(2, PAIRS).T)


def _row(networks: Pretrained, settings: TranslatorSettings, runs_on: Any) -> dict[str, Any]:
    """Train with all losses, then translate; return speeds and the peak of the memory."""
    device = runs_on.device
    if device.type == "cuda":
        gc.collect()
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    times: dict[int, float] = {}

    def stamp(done: int, total: int) -> None:
        if done in (WARM, total):
            times[done] = _now(device)

    session = TrainingSession(runs_on, progress=stamp)
    network = train(random_pairs(device), networks, settings, session=session)
    seconds = times[settings.steps] - times[WARM]
    memory = "-"
    if device.type == "cuda":
        memory = f"{torch.cuda.max_memory_allocated(device) / 2**30:.1f}"
    return {
        "batch": settings.batch,
        "training": settings.batch * (settings.steps - WARM) / seconds,
        "translation": _translated_per_s(network, settings, device),
        "memory": memory,
    }


def _translated_per_s(
    network: MarkerToMarker, settings: TranslatorSettings, device: torch.device
) -> float:
    """Return frames per second from masks to masks, with fused adapters as in `translate`."""
    fuse(network.unet)
    fuse(network.vae)
    lower = settings.launch.mixed_precision != "no"
    translator = DiffusionTranslator(
        network,
        "random weights",
        batch=settings.batch,
        precision=torch.bfloat16 if lower else torch.float32,
    )
    masks = enlarge_images(random_pairs(device).images)
    many = masks[torch.arange(TRANSLATED) % len(masks)] if device.type == "cuda" else masks
    translator.translate(many[: settings.batch], masks[0], masks[0])
    begun = _now(device)
    translator.translate(many, masks[0], masks[0])
    return len(many) / (_now(device) - begun)


def _now(device: torch.device) -> float:
    """Return the time [s] at which the device has finished its queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
