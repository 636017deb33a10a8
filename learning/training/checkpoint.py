"""The folder of a trained model: its weights, settings and provenance.

    model.safetensors     the weights; other networks of the training have files of their names
    config.yaml           kind, settings, metadata, data, code_version

A finished run is such a folder, and so is each of its checkpoints.
"""

import hashlib
import logging
import pickle
import subprocess
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn

from learning.config import READER
from learning.errors import LearningError
from recorder.settings import describe, yaml_text
from recorder.store import replace_file

# Network weights in safetensors files.

_SHOWN = 4
# Errors of `torch.load` for files that are damaged or hold more than plain values.
UNREADABLE = (pickle.UnpicklingError, RuntimeError, EOFError, LookupError, ValueError, OSError)

Network = TypeVar("Network", bound=nn.Module)


def save_weights(model: nn.Module | Mapping[str, Tensor], path: Path) -> None:
    """Write a module, not wrapped by Accelerate, or its state to a `.safetensors`, atomically."""
    state = model.state_dict() if isinstance(model, nn.Module) else model
    # Copied, as safetensors rejects tensors that share memory, e.g. tied weights.
    plain = {name: value.detach().cpu().clone().contiguous() for name, value in state.items()}
    replace_file(path, save(plain))


def read_weights(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a file, on the CPU."""
    try:
        weights: dict[str, Tensor] = load_file(path)
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (SafetensorError, OSError) as error:
        raise LearningError(f"{path}: corrupt or incomplete safetensors file: {error}") from None
    return weights


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a file by name: safetensors, or a pickle of tensors only."""
    content = read_plain(path)
    if not isinstance(content, dict) or not all(
        isinstance(value, Tensor) for value in content.values()
    ):
        raise LearningError(f"{path}: found {type(content).__name__}; allowed: named tensors")
    return content


def read_plain(path: Path) -> Any:
    """Return the content of a weights file; pickles may hold only tensors and plain values."""
    if not path.is_file():
        raise LearningError(f"{path}: no such file")
    if path.suffix == ".safetensors":
        return read_weights(path)
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except UNREADABLE as error:
        raise LearningError(f"{path}: is no file of weights: {first_line(error)}") from error


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, or its type."""
    return (str(error).splitlines() or [type(error).__name__])[0]


def load_weights(model: nn.Module, weights: Path | Mapping[str, Tensor], prefix: str = "") -> None:
    """Load weights, a file or its content, into a module; names and shapes must match exactly.

    The module is not wrapped by Accelerate; its `may_be_nan`, if any, names tensors in which NaN
    has a meaning. `prefix` begins messages of errors, unless a file's path does.
    """
    if isinstance(weights, Path):
        prefix, weights = str(weights), read_weights(weights)
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
            f"{prefix}: not the weights of this network: {'; '.join(wrong)}; allowed: "
            f"{len(own)} tensors, as its settings define"
        )
    may_be_nan: tuple[str, ...] = getattr(model, "may_be_nan", ())
    unsound = [
        name
        for name, value in weights.items()
        if value.is_floating_point()
        and not bool((~value.isinf() if name in may_be_nan else value.isfinite()).all())
    ]
    if unsound:
        raise LearningError(f"{prefix}: found NaN or infinity in {_listed(sorted(unsound))}")
    model.load_state_dict(dict(weights))


def weights_hash(path: Path) -> str:
    """Return the SHA-256 of a file, 64 hexadecimal digits."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None


def _listed(names: list[str], separator: str = ", ") -> str:
    rest = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return separator.join(names[:_SHOWN]) + rest


Settings = TypeVar("Settings")

logger = logging.getLogger(__name__)

CONFIG, MODEL = "config.yaml", "model"


@dataclass(frozen=True, slots=True)
class Config:
    """Settings and provenance of a model."""

    kind: str
    """Kind of model: `field`, `diffusion`, `force`, or one of another package."""
    settings: Mapping[str, Any]
    """Plain values, as `settings_to_dict` gives them."""
    data: str
    """Fingerprint of the training data."""
    code_version: str
    """Version of this package."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """Values found by training and needed to use the model, e.g. the force range; plain values."""
    step: int | None = None
    """Number of training steps; None: the run is not finished."""
    score: float | None = None
    """Validation score, lower is better; None: not scored."""

    def write(self, folder: Path) -> None:
        """Write it to a folder, atomically."""
        try:
            text = yaml_text(asdict(self))
        except yaml.YAMLError as error:
            raise LearningError(f"{folder / CONFIG}: not plain values: {error}") from None
        replace_file(folder / CONFIG, text.encode())


@dataclass(frozen=True, slots=True)
class ModelFolder:
    """A folder that holds a model."""

    path: Path
    config: Config

    def settings(self, kind: type[Settings], key: str = "") -> Settings:
        """Return those of its settings that a dataclass has, or those under a key."""
        key_path = f"{self.path / CONFIG}.settings"
        if key:
            return READER.build(kind, self.config.settings.get(key), f"{key_path}.{key}")
        names = {each.name for each in fields(kind)}  # type: ignore[arg-type]
        own = {name: each for name, each in self.config.settings.items() if name in names}
        return READER.build(kind, own, key_path)

    def weights(self) -> dict[str, Tensor]:
        """Read its weights."""
        return read_weights(self.file())

    def load(self, model: Network, device: torch.device | str = "cpu") -> Network:
        """Load its weights into a module; return the module on a device, in evaluation mode."""
        load_weights(model, self.file())
        return model.to(device).eval()

    def hash(self) -> str:
        """Return the SHA-256 of its weights."""
        return weights_hash(self.file())

    def file(self) -> Path:
        """Return the path of its weights."""
        return self.path / f"{MODEL}.safetensors"


def read_model_folder(path: Path, kind: str | None = None) -> ModelFolder:
    """Return the model of a kind, or any, in the folder of a finished run, or a checkpoint."""
    config = read_config(path)
    if kind is not None and config.kind != kind:
        raise LearningError(f"{path / CONFIG}: found kind {config.kind!r}; allowed: {kind!r}")
    if not (path / f"{MODEL}.safetensors").is_file():
        raise LearningError(
            f"{path}: found no {MODEL}.safetensors; allowed: a finished run, or one of its "
            "checkpoints"
        )
    return ModelFolder(path, config)


def read_config(folder: Path) -> Config:
    """Read the `Config` of a folder."""
    path = folder / CONFIG
    if not path.is_file():
        raise LearningError(f"{folder}: found no {CONFIG}; allowed: the folder of a training run")
    content = READER.read(path)
    allowed_keys = Config.__dataclass_fields__
    if unknown := sorted(set(content) - set(allowed_keys)):
        raise LearningError(
            f"{path}: unknown {', '.join(unknown)}; known: {', '.join(allowed_keys)}"
        )
    for key, kind in (("kind", str), ("settings", dict), ("data", str), ("code_version", str)):
        if not isinstance(content.get(key), kind):
            allowed = "text" if kind is str else "a mapping of keys to values"
            raise LearningError(
                f"{path}.{key}: found {describe(content.get(key))}; allowed: {allowed}"
            )
    return Config(**content)


@cache
def code_version() -> str:
    """Return the version of this code by `git describe`, or the package version without git."""
    root = Path(__file__).parents[2]
    # A package installed inside another project's repository does not belong to it.
    if (root / ".git").exists():
        try:
            message = subprocess.run(
                ["git", "describe", "--always", "--dirty", "--tags"],
                cwd=root,
                capture_output=True,
                text=True,
                timeout=10,
                check=True,
            )
            return message.stdout.strip()
        except (OSError, subprocess.SubprocessError) as error:
            logger.warning("git cannot describe this code: %s", error)
    try:
        return version("tactile-rig")
    except PackageNotFoundError:
        return "unknown"
