"""Trainings of the diffusion translator, and of its autoencoder, as they lie in folders.

A folder holds what the published weights do not: adapters, tokens and the UNet's first layer. The
published ones are read from `base/` in it (a folder or a link), or from where training found them;
`facts.base` says which ones they must be.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from learning.errors import LearningError
from learning.training.model_folder import ModelFolder, read_model_folder
from learning.training.weights import load_weights
from learning.translation.diffusion.adapters import fuse, is_adapter
from learning.translation.diffusion.network import MarkerToMarker, build, rank_of
from learning.translation.diffusion.settings import TranslatorSettings
from learning.translation.diffusion.translator import DiffusionTranslator
from learning.translation.diffusion.weights import fingerprint, read_unet, read_vae

KIND = "diffusion"
"""Of the folder of a translator."""
MARKER_VAE = "marker-vae"
"""Of the folder of a marker autoencoder."""
BASE = "base"
"""Name of the fact that tells published weights apart, and of the folder for them."""


def load(folder: str | Path, device: torch.device | str = "cpu") -> DiffusionTranslator:
    """Return the translator in the folder of a training run, its adapters fused for speed.

    On a GPU that has bfloat16 the network computes in it.

    Raises:
        LearningError: Not such a folder, or the published weights are missing or others.
    """
    found, device = read_model_folder(Path(folder), KIND), torch.device(device)
    network = load_network(found)
    fuse(network.unet)
    fuse(network.vae)
    lower = device.type == "cuda" and torch.cuda.is_bf16_supported()
    return DiffusionTranslator(
        network.to(device),
        f"{KIND} {found.hash()[:8]}",
        precision=torch.bfloat16 if lower else torch.float32,
    )


def load_network(found: ModelFolder) -> MarkerToMarker:
    """Return the network in a folder, its adapters apart from the published weights.

    Raises:
        LearningError: The published weights are missing or others, or the folder's do not fit.
    """
    settings = found.settings(TranslatorSettings)
    own = found.weights()
    base = base_of(found, settings.weights.base)
    network = build(
        read_unet(base),
        read_vae(base),
        replace(settings, vae_rank=rank_of(vae_adapter_of(own)), gradient_checkpointing=False),
    )
    load_weights(network, own, str(found.file()))
    return network


def load_vae_adapter(folder: str | Path, base: str) -> dict[str, torch.Tensor]:
    """Return what a marker autoencoder has learned, from its folder.

    Args:
        folder: Of its training.
        base: Fingerprint of the published weights that it will be put on.

    Raises:
        LearningError: Not such a folder, or one of other published weights.
    """
    found = read_model_folder(Path(folder), MARKER_VAE)
    require_base(found, base)
    return vae_adapter_of(found.weights())


def vae_adapter_of(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the autoencoder's adapter in the state of a translator or of an autoencoder."""
    return {
        name.removeprefix("vae."): tensor
        for name, tensor in state.items()
        if name.startswith("vae.") and is_adapter(name)
    }


def base_of(found: ModelFolder, said: str) -> str:
    """Return the folder of the published weights that a training was begun with.

    Args:
        found: The training's folder.
        said: Where they were then.

    Raises:
        LearningError: They are not there, or others are.
    """
    beside = found.path / BASE
    folder = str(beside) if beside.exists() else said
    if not (Path(folder) / "unet").is_dir():
        raise LearningError(
            f"{found.path}: found no published weights in {folder!r}; link the folder of SD-Turbo "
            f"that it was trained from to {beside}"
        )
    require_base(found, fingerprint(folder))
    return folder


def require_base(found: ModelFolder, base: str) -> None:
    """Refuse published weights that a training was not begun with.

    Raises:
        LearningError: They are others.
    """
    expected = found.config.facts.get(BASE)
    if expected != base:
        raise LearningError(
            f"{found.path}: was trained from published weights {expected}, found {base}; "
            "allowed: the same ones"
        )
