"""The folder of a trained model: its weights, and what it was made with and from.

    model.safetensors     the weights; other networks of the same training under their own names
    config.yaml           kind, settings, facts, data, code_version

A finished run is such a folder, and so is each of its checkpoints.
"""

from __future__ import annotations

import logging
import subprocess
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import yaml
from torch import Tensor, nn

from learning.errors import LearningError
from learning.settings import build, read_mapping
from learning.training.weights import load_weights, read_weights, weights_hash
from recorder.store.durable import replace_file
from recorder.strict_yaml import yaml_text

Settings = TypeVar("Settings")

logger = logging.getLogger(__name__)

CONFIG, MODEL = "config.yaml", "model"
KINDS = ("autoencoder", "field", "direct", "marker-vae", "diffusion", "force")
"""What a model may be."""


@dataclass(frozen=True, slots=True)
class Config:
    """What a model was made with and from."""

    kind: str
    """One of `KINDS`."""
    settings: Mapping[str, Any]
    """Plain values, as `settings_to_dict` gives them."""
    data: str
    """Fingerprint of what it was trained on."""
    code_version: str
    """Of this package."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """What was found and is needed to use it, such as the force range; plain values."""
    step: int | None = None
    """Steps that it was trained for; None: the run is not finished."""
    score: float | None = None
    """What it was judged by, less being better; None: it was not."""

    def write(self, folder: Path) -> None:
        """Write it to a folder, whole or not at all.

        Raises:
            LearningError: Settings or facts that are no plain values.
        """
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

    def settings(self, kind: type[Settings]) -> Settings:
        """Return its settings as the dataclass that they were.

        Raises:
            LearningError: They are not of that class.
        """
        return build(kind, dict(self.config.settings), f"{self.path / CONFIG}.settings")

    def weights(self, name: str = MODEL) -> dict[str, Tensor]:
        """Return the weights of one of its networks.

        Raises:
            LearningError: There are none, or the file is damaged.
        """
        return read_weights(self.file(name))

    def load(self, model: nn.Module, name: str = MODEL) -> None:
        """Give a network its weights.

        Raises:
            LearningError: There are none, or they are of another network.
        """
        load_weights(model, self.file(name))

    def hash(self, name: str = MODEL) -> str:
        """Return the SHA-256 of the weights of one of its networks.

        Raises:
            LearningError: There are none.
        """
        return weights_hash(self.file(name))

    def file(self, name: str = MODEL) -> Path:
        """Return the path of the weights of one of its networks."""
        return self.path / f"{name}.safetensors"


def read_model_folder(path: Path, kind: str | None = None) -> ModelFolder:
    """Return the model in a folder.

    Args:
        path: A finished run, or a checkpoint of one.
        kind: What it must be; None: any.

    Raises:
        LearningError: No such folder, no finished model, or one of another kind.
    """
    config = read_config(path)
    if kind is not None and config.kind != kind:
        raise LearningError(f"{path / CONFIG}: found kind {config.kind!r}; allowed: {kind!r}")
    if not (path / f"{MODEL}.safetensors").is_file():
        raise LearningError(
            f"{path}: found no {MODEL}.safetensors; allowed: a finished run, or one of its "
            "checkpoints"
        )
    return ModelFolder(path, config)


def load_finished(
    folder: Path, kind: str, settings: type[Settings]
) -> tuple[Settings, dict[str, Tensor]]:
    """Return the settings and the weights of a finished run.

    Args:
        folder: Of the run.
        kind: What the model must be.
        settings: Dataclass of its settings.

    Raises:
        LearningError: Not such a folder, a model of another kind, or a damaged file.
    """
    found = read_model_folder(folder, kind)
    return found.settings(settings), found.weights()


def read_config(folder: Path) -> Config:
    """Return what a folder says of its model.

    Raises:
        LearningError: It says nothing, or something else than models do.
    """
    path = folder / CONFIG
    if not path.is_file():
        raise LearningError(f"{folder}: found no {CONFIG}; allowed: the folder of a training run")
    content = read_mapping(path)
    known = Config.__dataclass_fields__
    if unknown := sorted(set(content) - set(known)):
        raise LearningError(f"{path}: unknown {', '.join(unknown)}; known: {', '.join(known)}")
    for key, kind in (("kind", str), ("settings", dict), ("data", str), ("code_version", str)):
        if not isinstance(content.get(key), kind):
            found = content.get(key)
            raise LearningError(f"{path}.{key}: found {found!r}; allowed: {kind.__name__}")
    return Config(**content)


@cache
def code_version() -> str:
    """Return what git calls this code, or the version of the package where there is no git."""
    root = Path(__file__).parents[2]
    # A package that is installed somewhere inside another project's repository is not of it.
    if (root / ".git").exists():
        try:
            said = subprocess.run(
                ["git", "describe", "--always", "--dirty", "--tags"],
                cwd=root,
                capture_output=True,
                text=True,
                timeout=10,
                check=True,
            )
            return said.stdout.strip()
        except (OSError, subprocess.SubprocessError) as error:
            logger.warning("git does not say which code this is: %s", error)
    return _package_version()


def _package_version() -> str:
    try:
        return version("tactile-rig")
    except PackageNotFoundError:
        return "unknown"
