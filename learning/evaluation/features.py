"""What turns images into features that distances are measured in, each named for what it is."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

Images = NDArray[np.uint8]
Floats = NDArray[np.float64]

CELLS = 8
"""Cells of the marker grid along each side."""
GRID = f"marker-grid-{CELLS}x{CELLS}"
"""Name of the features that need no weights."""
AUTOENCODER = "marker-ae"
_AT_ONCE = 64
_HASHED = 12  # digits of a hash that are shown


class Extractor(Protocol):
    """Turns images into features."""

    @property
    def name(self) -> str:
        """What made the features: a model and the hash of its weights."""
        ...

    @property
    def is_inception(self) -> bool:
        """Whether distances of these features are FID and KID."""
        ...

    def features(self, images: Images) -> Floats:
        """Return features (n, d) of images (n, 256, 256)."""
        ...


@dataclass(frozen=True, slots=True)
class MarkerGrid:
    """How much of each cell of a grid is marker, where in it, and how much of that is edge.

    Of 8 x 8 cells: the share that is set; the mean of what is set times its column, and its row,
    from -1 to 1 across the cell; the mean step to the next pixel, right and down. 256 numbers.
    """

    @property
    def name(self) -> str:
        """What made the features."""
        return GRID

    @property
    def is_inception(self) -> bool:
        """Whether distances of these features are FID and KID."""
        return False

    def features(self, images: Images) -> Floats:
        """Return features (n, 256) of images (n, 256, 256).

        Raises:
            LearningError: Not such images.
        """
        require_images(images)
        parts = range(0, len(images), _AT_ONCE)
        found = [self._of(images[first : first + _AT_ONCE]) for first in parts]
        return np.concatenate([np.empty((0, 4 * CELLS**2)), *found])

    def _of(self, images: Images) -> Floats:
        count, side = images.shape[:2]
        set_ = images.astype(np.float64) / 255
        right = np.abs(np.diff(set_, axis=2, append=set_[:, :, -1:]))
        down = np.abs(np.diff(set_, axis=1, append=set_[:, -1:]))
        width = side // CELLS
        across = np.linspace(-1, 1, width)
        cells = set_.reshape(count, CELLS, width, CELLS, width)
        edges = (right + down).reshape(count, CELLS, width, CELLS, width)
        area = width**2
        kinds = (
            cells.mean(axis=(2, 4)),
            np.einsum("nrycx,x->nrc", cells, across) / area,
            np.einsum("nrycx,y->nrc", cells, across) / area,
            edges.mean(axis=(2, 4)),
        )
        return np.stack(kinds, axis=1).reshape(count, -1)


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """Features of a network whose weights are in a file."""

    name: str
    """What made the features."""
    is_inception: bool
    """Whether distances of these features are FID and KID."""
    compute: Callable[[Images], Floats]
    """Returns features (n, d) of at most 64 images (n, 256, 256)."""

    def features(self, images: Images) -> Floats:
        """Return features (n, d) of images (n, 256, 256).

        Raises:
            LearningError: Not such images.
        """
        require_images(images)
        parts = range(0, max(len(images), 1), _AT_ONCE)
        return np.concatenate([self.compute(images[first : first + _AT_ONCE]) for first in parts])


def load_extractor(name_or_path: str, device: str = "cpu") -> Extractor:
    """Return what makes features.

    Args:
        name_or_path: `marker-grid`; the folder of a trained marker autoencoder; or the file
            pt_inception-2015-12-05-6726825d.pth, for FID and KID.
        device: Where networks compute.

    Raises:
        LearningError: None of them, or weights of something else.
    """
    if name_or_path in ("marker-grid", GRID):
        return MarkerGrid()
    path = Path(name_or_path)
    if path.is_dir():
        return _autoencoder(path, device)
    if path.is_file():
        from learning.evaluation.inception import RESIZED, load_inception

        network = load_inception(path, device)
        return Network(f"inception@{_sha256(path)}, {RESIZED}", True, network)
    raise LearningError(
        f"--features: found {name_or_path!r}; allowed: marker-grid, the folder of a trained marker "
        "autoencoder, or a file with the weights of Inception"
    )


def require_images(images: Images) -> None:
    """Refuse what is no image that networks see.

    Raises:
        LearningError: Not uint8, or not 256 x 256.
    """
    if images.dtype != np.uint8 or images.ndim != 3 or images.shape[1:] != (256, 256):
        raise LearningError(
            f"images: found {images.dtype} {images.shape}; allowed: uint8 (n, 256, 256)"
        )


def _autoencoder(folder: Path, device: str) -> Network:
    import torch

    from learning.translation.autoencoder import load_autoencoder

    model: Any = load_autoencoder(folder, device)

    def compute(images: Images) -> Floats:
        with torch.inference_mode():
            found = model.features(torch.from_numpy(images).to(device))
        return np.asarray(found.double().cpu().numpy(), np.float64)

    return Network(f"{AUTOENCODER}@{_sha256(folder / 'model.safetensors')}", False, compute)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()[:_HASHED]}"
