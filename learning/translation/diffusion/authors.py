"""Import of the authors' checkpoints, with tensors renamed to the names used here.

`model_N.pkl` of the translator holds ranks, names of adapted layers, and the adapters of UNet,
autoencoder and reference encoder; `checkpoint.pth` of the marker VAE holds one adapter. The
files contain only tensors, numbers and lists, so no code in a file is ever run.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from learning.config import read_settings
from learning.errors import LearningError
from learning.training.checkpoint import load_weights, read_plain, weights_hash
from learning.training.run import RunFolder
from learning.translation.diffusion.network import (
    UNET_ADAPTER,
    UNET_TARGETS,
    VAE_ADAPTER,
    VAE_TARGETS,
    MarkerToMarker,
    MarkerVae,
    build,
    is_adapter,
    rank_of,
)
from learning.translation.diffusion.train import PRESETS, TranslatorSettings
from learning.translation.diffusion.train_vae import MarkerVaeSettings
from learning.translation.diffusion.weights import (
    BASE,
    Weights,
    fingerprint,
    read_unet,
    read_vae,
    require_base_folder,
)

_ADAPTER = re.compile(r"\.lora_([AB])\.[^.]+\.weight$")


@dataclass(frozen=True, slots=True, eq=False)
class AuthorsCheckpoint:
    """Content of one of the authors' files."""

    kind: Literal["diffusion", "marker-vae"]
    """Kind of model."""
    tensors: dict[str, torch.Tensor]
    """State of the translator or of the marker VAE, under the names used here."""
    vae_rank: int
    """Rank of the autoencoder's adapter."""
    unet_rank: int = 0
    """Rank of the UNet's adapter; 0: none."""


def read_authors(path: Path) -> AuthorsCheckpoint:
    """Read one of the authors' checkpoints."""
    content = read_plain(path)
    if not isinstance(content, dict):
        raise LearningError(f"{path}: found {type(content).__name__}; allowed: a checkpoint")
    _require_targets(path, content, "vae_lora_target_modules", VAE_TARGETS)
    vae = _adapter(path, content, "state_dict_vae", VAE_ADAPTER)
    rank = _rank(path, content, "rank_vae", vae)
    if "state_dict_unet" not in content:
        tensors = {f"vae.{name}": each for name, each in vae.items()}
        return AuthorsCheckpoint("marker-vae", tensors, rank)
    _require_targets(path, content, "unet_lora_target_modules", UNET_TARGETS)
    _require_targets(path, content, "ref_encoder_lora_target_modules", VAE_TARGETS)
    unet = _adapter(path, content, "state_dict_unet", UNET_ADAPTER, also=("conv_in.",))
    reference = _adapter(path, content, "state_dict_ref_encoder", VAE_ADAPTER)
    if _rank(path, content, "rank_ref_encoder", reference) != rank:
        raise LearningError(f"{path}: rank_ref_encoder: differs from rank_vae ({rank})")
    tensors = {f"unet.{name}": each for name, each in unet.items()}
    tensors |= {f"vae.{name}": each for name, each in vae.items()}
    # The reference encoder needs no decoder.
    tensors |= {
        f"reference.{name}": each for name, each in reference.items() if name.startswith("encoder.")
    }
    return AuthorsCheckpoint("diffusion", tensors, rank, _rank(path, content, "rank_unet", unet))


def _adapter(
    path: Path, content: Mapping[str, Any], key: str, adapter: str, also: tuple[str, ...] = ()
) -> dict[str, torch.Tensor]:
    """Return the tensors under a key, with their adapter renamed."""
    stored = content.get(key)
    if not isinstance(stored, Mapping) or not stored:
        raise LearningError(f"{path}: {key}: missing; allowed: a checkpoint of the authors' code")
    tensors = {}
    for name, tensor in stored.items():
        if not isinstance(tensor, torch.Tensor) or not (is_adapter(name) or name.startswith(also)):
            raise LearningError(f"{path}: {key}: found {name!r}; allowed: tensors of adapters")
        if not bool(tensor.isfinite().all()):
            raise LearningError(f"{path}: {key}: {name}: holds values that are not finite")
        renamed = _ADAPTER.sub(rf".lora_\1.{adapter}.weight", name)
        tensors[renamed] = tensor.float().contiguous()
    return tensors


def _rank(
    path: Path, content: Mapping[str, Any], key: str, adapter: Mapping[str, torch.Tensor]
) -> int:
    rank = rank_of(adapter)
    if content.get(key) != rank:
        raise LearningError(f"{path}: {key}: found {content.get(key)!r}; its tensors have {rank}")
    return rank


def _require_targets(
    path: Path, content: Mapping[str, Any], key: str, targets: tuple[str, ...]
) -> None:
    stored = content.get(key)
    if not isinstance(stored, list | tuple | set) or set(stored) != set(targets):
        raise LearningError(f"{path}: {key}: found {stored!r}; allowed: {list(targets)}")


def import_checkpoint(path: Path, base: str, out: Path) -> tuple[str, int]:
    """Write a run folder from one of the authors' files; return kind and number of parameters.

    The network is built on the published weights, SD-Turbo in `base`, first, so that a checkpoint
    that does not fit is rejected before anything is written. `out` is new or empty.
    """
    checkpoint = read_authors(path)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise LearningError(f"{out}: is not empty; allowed: a new or empty folder")
    require_base_folder(base)
    preset = read_settings(TranslatorSettings, PRESETS, "authors_code")
    preset = replace(preset, weights=Weights(base=base), vae_rank=checkpoint.vae_rank)
    settings: MarkerVaeSettings
    network: MarkerToMarker | MarkerVae
    if checkpoint.kind == "diffusion":
        settings = preset = replace(preset, unet_rank=checkpoint.unet_rank)
        network = build(read_unet(base), read_vae(base), preset)
    else:
        settings = preset.of_marker_vae()
        network = MarkerVae(read_vae(base), settings)
    load_weights(network, checkpoint.tensors, str(path))
    metadata = {
        BASE: fingerprint(base),
        "imported_from": f"{path.name} sha256 {weights_hash(path)}",
    }
    run = RunFolder.open(
        out, checkpoint.kind, settings, "the authors' checkpoint", metadata=metadata
    )
    if run.finished:
        raise LearningError(f"{out}: a run is there; allowed: another folder")
    run.finish(0, {"model": network})
    return checkpoint.kind, sum(tensor.numel() for tensor in checkpoint.tensors.values())
