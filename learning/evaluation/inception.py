"""Inception v3 as FID and KID take it: 2048 features, with weights that the user has.

The weights are those that TensorFlow published in 2015 for Inception, as ported to PyTorch in the
file `pt_inception-2015-12-05-6726825d.pth`; FID is defined by them. Against Inception v3 elsewhere,
averages leave out the border and the last block takes a maximum (Heusel et al., 2017; the port's
documentation). Layers are named as in that file.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from learning.errors import LearningError

FEATURES = 2048
SIDE = 299
RESIZED = "bilinear to 299"
"""How images come to the size that it takes, without antialiasing."""


@dataclass(frozen=True, slots=True)
class Step:
    """One convolution of a branch."""

    name: str
    """Name of the layer."""
    width: int
    """Channels it makes."""
    kernel: tuple[int, int] = (1, 1)
    """Rows and columns it sees."""
    stride: int = 1
    """2 halves the sides, and keeps to what lies inside."""


Branch = tuple[Step, ...]
_ACROSS, _DOWN = (1, 7), (7, 1)
_THREE, _FIVE = (3, 3), (5, 5)


@dataclass(frozen=True, slots=True)
class Design:
    """One block: branches side by side, and what is pooled."""

    branches: tuple[Branch, ...]
    """Each from the block's input."""
    pooled: int
    """Channels made of the pooled input; 0: it is taken as it is."""
    forks: tuple[tuple[Step, Step], ...] = ()
    """Two convolutions behind each of the last branches, side by side."""
    pooling: str = "mean"
    """`mean` or `max` of 3 x 3; `halve`: the maximum at every second place."""


def _fives(pooled: int) -> Design:
    return Design(
        (
            (Step("branch1x1", 64),),
            (Step("branch5x5_1", 48), Step("branch5x5_2", 64, _FIVE)),
            (
                Step("branch3x3dbl_1", 64),
                Step("branch3x3dbl_2", 96, _THREE),
                Step("branch3x3dbl_3", 96, _THREE),
            ),
        ),
        pooled,
    )


def _sevens(width: int) -> Design:
    return Design(
        (
            (Step("branch1x1", 192),),
            (
                Step("branch7x7_1", width),
                Step("branch7x7_2", width, _ACROSS),
                Step("branch7x7_3", 192, _DOWN),
            ),
            (
                Step("branch7x7dbl_1", width),
                Step("branch7x7dbl_2", width, _DOWN),
                Step("branch7x7dbl_3", width, _ACROSS),
                Step("branch7x7dbl_4", width, _DOWN),
                Step("branch7x7dbl_5", 192, _ACROSS),
            ),
        ),
        192,
    )


def _forked(pooling: str) -> Design:
    def fork(name: str) -> tuple[Step, Step]:
        return Step(f"{name}a", 384, (1, 3)), Step(f"{name}b", 384, (3, 1))

    return Design(
        (
            (Step("branch1x1", 320),),
            (Step("branch3x3_1", 384),),
            (Step("branch3x3dbl_1", 448), Step("branch3x3dbl_2", 384, _THREE)),
        ),
        192,
        (fork("branch3x3_2"), fork("branch3x3dbl_3")),
        pooling,
    )


_HALVE_FIRST = Design(
    (
        (Step("branch3x3", 384, _THREE, 2),),
        (
            Step("branch3x3dbl_1", 64),
            Step("branch3x3dbl_2", 96, _THREE),
            Step("branch3x3dbl_3", 96, _THREE, 2),
        ),
    ),
    0,
    pooling="halve",
)
_HALVE_SECOND = Design(
    (
        (Step("branch3x3_1", 192), Step("branch3x3_2", 320, _THREE, 2)),
        (
            Step("branch7x7x3_1", 192),
            Step("branch7x7x3_2", 192, _ACROSS),
            Step("branch7x7x3_3", 192, _DOWN),
            Step("branch7x7x3_4", 192, _THREE, 2),
        ),
    ),
    0,
    pooling="halve",
)
_BLOCKS = (
    ("Mixed_5b", _fives(32), 256),
    ("Mixed_5c", _fives(64), 288),
    ("Mixed_5d", _fives(64), 288),
    ("Mixed_6a", _HALVE_FIRST, 768),
    ("Mixed_6b", _sevens(128), 768),
    ("Mixed_6c", _sevens(160), 768),
    ("Mixed_6d", _sevens(160), 768),
    ("Mixed_6e", _sevens(192), 768),
    ("Mixed_7a", _HALVE_SECOND, 1280),
    ("Mixed_7b", _forked("mean"), FEATURES),
    ("Mixed_7c", _forked("max"), FEATURES),
)
"""Name, design and channels of the blocks, in their order."""


class Convolution(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(self, before: int, step: Step, *, inside: bool = False) -> None:
        """Build it; `inside`: it sees nothing beyond the border, as halving ones never do."""
        super().__init__()
        rows, columns = step.kernel
        beyond = (0, 0) if inside or step.stride > 1 else (rows // 2, columns // 2)
        self.conv = nn.Conv2d(before, step.width, step.kernel, step.stride, beyond, bias=False)
        self.bn = nn.BatchNorm2d(step.width, eps=0.001)

    def forward(self, images: Tensor) -> Tensor:
        """Return features."""
        return functional.relu(self.bn(self.conv(images)))


class Block(nn.Module):
    """One block."""

    def __init__(self, before: int, design: Design) -> None:
        """Build a block of `before` channels."""
        super().__init__()
        self.design = design
        ends = []
        for branch in design.branches:
            width = before
            for step in branch:
                self.add_module(step.name, Convolution(width, step))
                width = step.width
            ends.append(width)
        forked = ends[len(ends) - len(design.forks) :]
        for fork, width in zip(design.forks, forked, strict=True):
            for step in fork:
                self.add_module(step.name, Convolution(width, step))
        if design.pooled:
            self.branch_pool = Convolution(before, Step("branch_pool", design.pooled))

    def forward(self, features: Tensor) -> Tensor:
        """Return features of all branches behind each other."""
        found: list[Tensor] = []
        plain = len(self.design.branches) - len(self.design.forks)
        for number, branch in enumerate(self.design.branches):
            inner = features
            for step in branch:
                inner = self.get_submodule(step.name)(inner)
            if number < plain:
                found.append(inner)
            else:
                fork = self.design.forks[number - plain]
                found += [self.get_submodule(step.name)(inner) for step in fork]
        pooled = self._pooled(features)
        return torch.cat([*found, self.branch_pool(pooled) if self.design.pooled else pooled], 1)

    def _pooled(self, features: Tensor) -> Tensor:
        if self.design.pooling == "mean":
            return functional.avg_pool2d(features, 3, 1, 1, count_include_pad=False)
        if self.design.pooling == "max":
            return functional.max_pool2d(features, 3, 1, 1)
        return functional.max_pool2d(features, 3, 2)


class Inception(nn.Module):
    """Images to 2048 features."""

    def __init__(self) -> None:
        """Build it with untrained weights."""
        super().__init__()
        self.Conv2d_1a_3x3 = Convolution(3, Step("", 32, _THREE, 2))
        self.Conv2d_2a_3x3 = Convolution(32, Step("", 32, _THREE), inside=True)
        self.Conv2d_2b_3x3 = Convolution(32, Step("", 64, _THREE))
        self.Conv2d_3b_1x1 = Convolution(64, Step("", 80))
        self.Conv2d_4a_3x3 = Convolution(80, Step("", 192, _THREE), inside=True)
        width = 192
        for name, design, made in _BLOCKS:
            self.add_module(name, Block(width, design))
            width = made

    def forward(self, images: Tensor) -> Tensor:
        """Return features (n, 2048) of images (n, 1, h, w) in 0..1."""
        grey = functional.interpolate(images, (SIDE, SIDE), mode="bilinear", align_corners=False)
        features = 2 * grey.expand(-1, 3, -1, -1) - 1
        features = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(features)))
        features = self.Conv2d_3b_1x1(functional.max_pool2d(features, 3, 2))
        features = functional.max_pool2d(self.Conv2d_4a_3x3(features), 3, 2)
        for name, _, _ in _BLOCKS:
            features = self.get_submodule(name)(features)
        return features.mean(dim=(2, 3))


def load_inception(
    path: Path, device: str = "cpu"
) -> Callable[[NDArray[np.uint8]], NDArray[np.float64]]:
    """Return what makes features (n, 2048) of images (n, 256, 256) uint8.

    Args:
        path: The file of the weights.
        device: Where it computes.

    Raises:
        LearningError: Weights of something else.
    """
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
        kept = {name: value for name, value in weights.items() if not name.startswith("fc.")}
    except (RuntimeError, pickle.UnpicklingError, EOFError, AttributeError) as error:
        raise LearningError(f"{path}: found no weights: {error}") from None
    with torch.device("meta"):  # shapes alone
        here = Inception().state_dict()
    wrong = sorted(
        name
        for name in here.keys() | kept.keys()
        if not name.endswith("num_batches_tracked")
        and (name not in here or name not in kept or here[name].shape != kept[name].shape)
    )
    if wrong:
        raise LearningError(
            f"{path}: found {len(wrong)} layers that are missing, unknown or of another shape, "
            f"such as {wrong[0]}; allowed: the weights of Inception for FID"
        )
    network = Inception()
    network.load_state_dict(kept, strict=False)
    network.eval().requires_grad_(False).to(device)

    def compute(images: NDArray[np.uint8]) -> NDArray[np.float64]:
        with torch.inference_mode():
            scaled = torch.from_numpy(images).to(device).unsqueeze(1).float() / 255
            return np.asarray(network(scaled).double().cpu().numpy(), np.float64)

    return compute
