"""Weights of networks in files: safetensors, and errors that say what does not fit."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from learning.errors import LearningError
from recorder.store.durable import replace_file

_SHOWN = 4


def save_weights(model: nn.Module | Mapping[str, Tensor], path: Path) -> None:
    """Write the state of a module, whole or not at all.

    Args:
        model: The module, not wrapped by Accelerate, or its state.
        path: The file, `.safetensors`.
    """
    state = model.state_dict() if isinstance(model, nn.Module) else model
    # Copies: safetensors refuses tensors that share memory, as tied weights do.
    plain = {name: value.detach().cpu().clone().contiguous() for name, value in state.items()}
    replace_file(path, save(plain))


def read_weights(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file, on the CPU.

    Raises:
        LearningError: No such file, or not safetensors.
    """
    try:
        weights: dict[str, Tensor] = load_file(path)
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (SafetensorError, OSError) as error:
        raise LearningError(f"{path}: not a whole safetensors file: {error}") from None
    return weights


def load_weights(model: nn.Module, weights: Path | Mapping[str, Tensor], where: str = "") -> None:
    """Give a module the weights of a file, all of them and no others.

    Args:
        model: The module, not wrapped by Accelerate.
        weights: The file, or what was read from it.
        where: Begins the message of an error; the file's path where there is one.

    Raises:
        LearningError: No such file, names that are missing or unknown, or other shapes.
    """
    if isinstance(weights, Path):
        where, weights = str(weights), read_weights(weights)
    own = model.state_dict()
    wrong = []
    if missing := sorted(own.keys() - weights.keys()):
        wrong.append(f"missing {_listed(missing)}")
    if unexpected := sorted(weights.keys() - own.keys()):
        wrong.append(f"unexpected {_listed(unexpected)}")
    shapes = [
        f"{name} {tuple(weights[name].shape)}, expected {tuple(own[name].shape)}"
        for name in own.keys() & weights.keys()
        if weights[name].shape != own[name].shape
    ]
    if shapes:
        wrong.append(f"shapes {_listed(sorted(shapes), '; ')}")
    if wrong:
        raise LearningError(
            f"{where}: not the weights of this network: {'; '.join(wrong)}; allowed: "
            f"{len(own)} tensors of the settings beside them"
        )
    unsound = [
        name
        for name, value in weights.items()
        if value.is_floating_point() and not bool(torch.isfinite(value).all())
    ]
    if unsound:
        raise LearningError(f"{where}: found NaN or infinity in {_listed(sorted(unsound))}")
    model.load_state_dict(dict(weights))


def weights_hash(path: Path) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits.

    Raises:
        LearningError: No such file.
    """
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None


def _listed(names: list[str], between: str = ", ") -> str:
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return between.join(names[:_SHOWN]) + rest
