"""Networks like SD-Turbo, CLIP and VGG16, each with a few thousand random weights."""

from pathlib import Path
from typing import Any

import torch

from benchmarks.paper.full_size import random_pretrained
from learning.config import read_settings
from learning.data.pairs import PairedFrames
from learning.translation.diffusion.train import PRESETS, Pretrained, TranslatorSettings
from learning.translation.diffusion.train_vae import MarkerVaeSettings

# Size of images; their latents are 4 x 4.
SIDE = 16
# Width of the cross-attention: the number of a latent's pixels, as in the real networks at 256.
WIDTH = 16
UNET: dict[str, Any] = {
    "sample_size": 4,
    "in_channels": 4,
    "out_channels": 4,
    "down_block_types": ["CrossAttnDownBlock2D", "DownBlock2D"],
    "up_block_types": ["UpBlock2D", "CrossAttnUpBlock2D"],
    "block_out_channels": [8, 16],
    "layers_per_block": 1,
    "norm_num_groups": 4,
    "attention_head_dim": [2, 4],
    "cross_attention_dim": WIDTH,
    "use_linear_projection": True,
}
VAE: dict[str, Any] = {
    "in_channels": 3,
    "out_channels": 3,
    "down_block_types": ["DownEncoderBlock2D"] * 3,
    "up_block_types": ["UpDecoderBlock2D"] * 3,
    "block_out_channels": [4, 4, 8],
    "layers_per_block": 1,
    "norm_num_groups": 2,
    "latent_channels": 4,
    "scaling_factor": 0.18215,
}
# For images of 256 x 256, which have latents of 16 x 16 with it.
DEEP_VAE: dict[str, Any] = {
    **VAE,
    "down_block_types": ["DownEncoderBlock2D"] * 5,
    "up_block_types": ["UpDecoderBlock2D"] * 5,
    "block_out_channels": [2, 2, 2, 4, 4],
}
CLIP: dict[str, Any] = {
    "hidden_size": 8,
    "intermediate_size": 16,
    "num_hidden_layers": 9,
    "num_attention_heads": 2,
    "image_size": 32,
    "patch_size": 8,
    "projection_dim": 6,
}
VGG = (2, 2, 3, 3, 3)
# Stage of the marker VAE for a few steps.
VAE_STAGE = (
    "{steps: 4, batch: 2, mixed_precision: no, optimiser: {rate: {kind: constant, rate: 0.01}}}"
)


def tiny_pretrained(vae: dict[str, Any] = VAE) -> Pretrained:
    """Return networks that differ from the full-size ones only in size."""
    width = WIDTH if vae is VAE else 256
    return random_pretrained({**UNET, "cross_attention_dim": width}, vae, CLIP, VGG)


def write_base(folder: Path, vae: dict[str, Any] = VAE) -> Path:
    """Write SD-Turbo's two networks in the layout of diffusers, using diffusers."""
    made = tiny_pretrained(vae)
    made.unet.save_pretrained(folder / "unet")
    made.vae.save_pretrained(folder / "vae")
    return folder


def write_judges(folder: Path) -> dict[str, Path]:
    """Write CLIP, VGG16 and LPIPS' heads in their published layouts; return paths by option."""
    made = tiny_pretrained()
    made.clip.save_pretrained(folder / "clip")
    distance = made.perceptual
    vgg = {**distance.features.state_dict(prefix="features."), "classifier.0.bias": torch.ones(2)}
    torch.save(vgg, folder / "vgg.pth")
    heads = {f"lin{stage}.model.1.weight": head for stage, head in enumerate(distance.heads)}
    torch.save({name: head.detach() for name, head in heads.items()}, folder / "lpips.pth")
    return {"clip": folder / "clip", "vgg": folder / "vgg.pth", "lpips": folder / "lpips.pth"}


def tiny_settings(preset: str = "ours", **weights: str) -> TranslatorSettings:
    """Return a preset for a few steps on a CPU, with tiny adapters."""
    few = ["steps=4", "batch=2", "launch={device: cpu, mixed_precision: no}", "log_every=1"]
    few += [f"marker_vae={VAE_STAGE}"]
    given = [f"weights.{name}={value}" for name, value in weights.items()]
    return read_settings(
        TranslatorSettings,
        PRESETS,
        preset,
        [*few, "unet_rank=2", "vae_rank=2", "optimiser.rate={kind: constant, rate: 0.01}", *given],
    )


def tiny_vae_settings(*overrides: str, stage: str = VAE_STAGE) -> MarkerVaeSettings:
    """Return settings of a marker VAE for a few steps on a CPU."""
    few = [f"marker_vae={stage}", "launch.device=cpu", "log_every=1", *overrides]
    return read_settings(TranslatorSettings, PRESETS, "ours", few).of_marker_vae()


def striped_pairs(count: int = 4) -> PairedFrames:
    """Return pairs of stripes: the target has those of the source, rotated by a right angle."""
    lines = torch.arange(SIDE)
    shifted = torch.stack([((lines + 2 * each) // 4) % 2 for each in range(count)])
    source = (shifted[:, None, :] * 255).expand(-1, SIDE, -1).to(torch.uint8)
    images = torch.cat((source, source.transpose(1, 2)))
    belongs = torch.arange(2 * count) // count
    pairs = torch.arange(2 * count).view(2, count).T
    return PairedFrames(images, belongs, belongs, images[[0, count]], pairs)
