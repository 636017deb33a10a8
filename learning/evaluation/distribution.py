"""Distances between two sets of images: features, their distances, and their mixing.

The first features are those of Inception v3 for FID and KID: 2048 features, with weights that the
user provides. These are the weights of Inception published by TensorFlow in 2015, as ported to
PyTorch in the file `pt_inception-2015-12-05-6726825d.pth`; they define FID. In contrast to other
versions of Inception v3, averages exclude the border and the last block takes a maximum (Heusel et
al., 2017; the port's documentation). Layers are named as in that file.
"""

import pickle
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from learning.data.images import unit
from learning.errors import LearningError
from learning.training.checkpoint import weights_hash

FEATURES = 2048
SIDE = 299
# Resizing of images to its input size, without antialiasing.
RESIZED = "bilinear to 299"


@dataclass(frozen=True, slots=True)
class ConvLayer:
    """One convolution of a branch."""

    name: str
    width: int
    """Number of output channels."""
    kernel: tuple[int, int] = (1, 1)
    """Rows and columns of the kernel."""
    stride: int = 1
    """2 halves the sides, without padding."""


Branch = tuple[ConvLayer, ...]
_ACROSS, _DOWN = (1, 7), (7, 1)
_THREE, _FIVE = (3, 3), (5, 5)


@dataclass(frozen=True, slots=True)
class BlockDesign:
    """One block: parallel branches, and a pooled branch."""

    branches: tuple[Branch, ...]
    """Branches from the block's input."""
    pooled: int
    """Channels of the convolution after pooling; 0: none."""
    forks: tuple[tuple[ConvLayer, ConvLayer], ...] = ()
    """Two parallel convolutions at the end of each of the last branches."""
    pooling: str = "mean"
    """`mean` or `max` of 3 x 3; `halve`: the maximum, with stride 2."""


def _chain(name: str, *layers: tuple[Any, ...]) -> Branch:
    """Return a branch of convolutions `name_1` and so on: width, kernel and stride of each."""
    return tuple(ConvLayer(f"{name}_{number}", *one) for number, one in enumerate(layers, 1))


def _fives(pooled: int) -> BlockDesign:
    return BlockDesign(
        (
            (ConvLayer("branch1x1", 64),),
            _chain("branch5x5", (48,), (64, _FIVE)),
            _chain("branch3x3dbl", (64,), (96, _THREE), (96, _THREE)),
        ),
        pooled,
    )


def _sevens(width: int) -> BlockDesign:
    twice = (width, _DOWN), (width, _ACROSS)
    return BlockDesign(
        (
            (ConvLayer("branch1x1", 192),),
            _chain("branch7x7", (width,), (width, _ACROSS), (192, _DOWN)),
            _chain("branch7x7dbl", (width,), *twice, (width, _DOWN), (192, _ACROSS)),
        ),
        192,
    )


def _forked(pooling: str) -> BlockDesign:
    def fork(name: str) -> tuple[ConvLayer, ConvLayer]:
        return ConvLayer(f"{name}a", 384, (1, 3)), ConvLayer(f"{name}b", 384, (3, 1))

    return BlockDesign(
        (
            (ConvLayer("branch1x1", 320),),
            _chain("branch3x3", (384,)),
            _chain("branch3x3dbl", (448,), (384, _THREE)),
        ),
        192,
        (fork("branch3x3_2"), fork("branch3x3dbl_3")),
        pooling,
    )


_HALVE_FIRST = BlockDesign(
    (
        (ConvLayer("branch3x3", 384, _THREE, 2),),
        _chain("branch3x3dbl", (64,), (96, _THREE), (96, _THREE, 2)),
    ),
    0,
    pooling="halve",
)
_HALVE_SECOND = BlockDesign(
    (
        _chain("branch3x3", (192,), (320, _THREE, 2)),
        _chain("branch7x7x3", (192,), (192, _ACROSS), (192, _DOWN), (192, _THREE, 2)),
    ),
    0,
    pooling="halve",
)
# Name, design and output channels of the blocks, in order.
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


class NormedConvolution(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(self, before: int, layer: ConvLayer, *, inside: bool = False) -> None:
        """Build the layer; without padding if `inside` or if it halves the sides."""
        super().__init__()
        rows, columns = layer.kernel
        beyond = (0, 0) if inside or layer.stride > 1 else (rows // 2, columns // 2)
        self.conv = nn.Conv2d(before, layer.width, layer.kernel, layer.stride, beyond, bias=False)
        self.bn = nn.BatchNorm2d(layer.width, eps=0.001)

    def forward(self, images: Tensor) -> Tensor:
        """Return features."""
        return functional.relu(self.bn(self.conv(images)))


class Block(nn.Module):
    """One Inception block."""

    def __init__(self, before: int, design: BlockDesign) -> None:
        super().__init__()
        self.design = design
        ends = []
        for branch in design.branches:
            width = before
            for layer in branch:
                self.add_module(layer.name, NormedConvolution(width, layer))
                width = layer.width
            ends.append(width)
        forked = ends[len(ends) - len(design.forks) :]
        for fork, width in zip(design.forks, forked, strict=True):
            for layer in fork:
                self.add_module(layer.name, NormedConvolution(width, layer))
        if design.pooled:
            self.branch_pool = NormedConvolution(before, ConvLayer("branch_pool", design.pooled))

    def forward(self, features: Tensor) -> Tensor:
        """Return the concatenated features of all branches."""
        outputs: list[Tensor] = []
        plain = len(self.design.branches) - len(self.design.forks)
        for number, branch in enumerate(self.design.branches):
            inner = features
            for layer in branch:
                inner = self.get_submodule(layer.name)(inner)
            if number < plain:
                outputs.append(inner)
            else:
                fork = self.design.forks[number - plain]
                outputs += [self.get_submodule(layer.name)(inner) for layer in fork]
        pooled = self._pooled(features)
        return torch.cat([*outputs, self.branch_pool(pooled) if self.design.pooled else pooled], 1)

    def _pooled(self, features: Tensor) -> Tensor:
        if self.design.pooling == "mean":
            return functional.avg_pool2d(features, 3, 1, 1, count_include_pad=False)
        if self.design.pooling == "max":
            return functional.max_pool2d(features, 3, 1, 1)
        return functional.max_pool2d(features, 3, 2)


class Inception(nn.Module):
    """Network from images to 2048 features."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = NormedConvolution(3, ConvLayer("", 32, _THREE, 2))
        self.Conv2d_2a_3x3 = NormedConvolution(32, ConvLayer("", 32, _THREE), inside=True)
        self.Conv2d_2b_3x3 = NormedConvolution(32, ConvLayer("", 64, _THREE))
        self.Conv2d_3b_1x1 = NormedConvolution(64, ConvLayer("", 80))
        self.Conv2d_4a_3x3 = NormedConvolution(80, ConvLayer("", 192, _THREE), inside=True)
        width = 192
        for name, design, output_width in _BLOCKS:
            self.add_module(name, Block(width, design))
            width = output_width

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
    """Return a function that computes features (n, 2048) of images (n, 256, 256) uint8."""
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
        state = {name: value for name, value in weights.items() if not name.startswith("fc.")}
    except (RuntimeError, pickle.UnpicklingError, EOFError, AttributeError) as error:
        raise LearningError(f"{path}: found no weights: {error}") from None
    with torch.device("meta"):  # shapes only
        here = Inception().state_dict()
    wrong = sorted(
        name
        for name in here.keys() | state.keys()
        if not name.endswith("num_batches_tracked")
        and (name not in here or name not in state or here[name].shape != state[name].shape)
    )
    if wrong:
        raise LearningError(
            f"{path}: found {len(wrong)} layers that are missing, unknown or of another shape, "
            f"such as {wrong[0]}; allowed: the weights of Inception for FID"
        )
    network = Inception()
    network.load_state_dict(state, strict=False)
    network.eval().requires_grad_(False).to(device)

    def compute(images: NDArray[np.uint8]) -> NDArray[np.float64]:
        with torch.inference_mode():
            scaled = torch.from_numpy(images).to(device).unsqueeze(1).float() / 255
            return np.asarray(network(scaled).double().cpu().numpy(), np.float64)

    return compute


# Extractors of the features in which distances are measured.

Images = NDArray[np.uint8]
Floats = NDArray[np.float64]

# Cells of the marker grid along each side.
CELLS = 8
# Name of the features that need no weights.
GRID = f"marker-grid-{CELLS}x{CELLS}"
_AT_ONCE = 64
_HASHED = 12  # number of digits of a hash in names


@dataclass(frozen=True, slots=True, eq=False)
class Extractor:
    """Computes features of images."""

    name: str
    """Its name: of a network with the hash of its weights."""
    compute: Callable[[Images], Floats]
    """Function that returns features (n, d) of at most 64 images (n, 256, 256)."""

    def features(self, images: Images) -> Floats:
        """Return features (n, d) of images (n, 256, 256)."""
        if images.dtype != np.uint8 or images.ndim != 3 or images.shape[1:] != (256, 256):
            raise LearningError(
                f"images: found {images.dtype} {images.shape}; allowed: uint8 (n, 256, 256)"
            )
        parts = range(0, max(len(images), 1), _AT_ONCE)
        return np.concatenate([self.compute(images[first : first + _AT_ONCE]) for first in parts])


def _marker_grid(images: Images) -> Floats:
    """Return marker coverage, position and edges in the cells of a grid (n, 256).

    For each of 8 x 8 cells: the covered fraction; the mean of coverage times column, and times row,
    from -1 to 1 across the cell; the mean step to the next pixel, right and down.
    """
    count, side = images.shape[:2]
    coverage = images.astype(np.float64) / 255
    right = np.abs(np.diff(coverage, axis=2, append=coverage[:, :, -1:]))
    down = np.abs(np.diff(coverage, axis=1, append=coverage[:, -1:]))
    width = side // CELLS
    across = np.linspace(-1, 1, width)
    cells = coverage.reshape(count, CELLS, width, CELLS, width)
    edges = (right + down).reshape(count, CELLS, width, CELLS, width)
    area = width**2
    kinds = (
        cells.mean(axis=(2, 4)),
        np.einsum("nrycx,x->nrc", cells, across) / area,
        np.einsum("nrycx,y->nrc", cells, across) / area,
        edges.mean(axis=(2, 4)),
    )
    return np.stack(kinds, axis=1).reshape(count, 4 * CELLS**2)


MARKER_GRID = Extractor(GRID, _marker_grid)


def load_extractor(name_or_path: str, device: str = "cpu") -> Extractor:
    """Load an extractor of features.

    It is `marker-grid`, the folder of a trained marker VAE, or the file
    pt_inception-2015-12-05-6726825d.pth, for FID and KID.
    """
    if name_or_path in ("marker-grid", GRID):
        return MARKER_GRID
    path = Path(name_or_path)
    if path.is_dir():
        return _marker_vae(path, device)
    if path.is_file():
        compute = load_inception(path, device)
        return Extractor(f"inception@{_sha256(path)}, {RESIZED}", compute)
    raise LearningError(
        f"--features: found {name_or_path!r}; allowed: marker-grid, the folder of a trained marker "
        "VAE, or a file with the weights of Inception"
    )


def _marker_vae(folder: Path, device: str) -> Extractor:
    """Return features (n, 4 * 64) of a marker VAE: the mean of its latent in 8 x 8 cells."""
    from learning.translation.diffusion.network import MARKER_VAE, load_vae

    vae = load_vae(folder, device)

    def compute(images: Images) -> Floats:
        with torch.inference_mode():
            latent = vae.latent(unit(torch.from_numpy(images).to(device)))
            cells = functional.adaptive_avg_pool2d(latent, CELLS).flatten(1)
        return np.asarray(cells.double().cpu().numpy(), np.float64)

    return Extractor(f"{MARKER_VAE}@{_sha256(folder / 'model.safetensors')}", compute)


def _sha256(path: Path) -> str:
    return f"sha256:{weights_hash(path)[:_HASHED]}"


# Distances between two sets of features: Frechet distance and kernel distance.
#
# They are called FID and KID only with the features of Inception; otherwise they are named by their
# extractor.

# Degree of the kernel (x y / d + 1)^degree of the kernel distance (Binkowski et al., 2018).
DEGREE = 3


def frechet_distance(one: Floats, other: Floats) -> float:
    """Return the Frechet distance of two sets of features (n, d), (m, d), taken as Gaussian.

    |mean1 - mean2|^2 + tr(C1 + C2 - 2 (C1 C2)^(1/2)), covariances with n - 1 (Heusel et al., 2017).
    The last trace is computed as the sum of the singular values of A B', where A' A = C1 and
    B' B = C2: with fewer samples than features, roots of eigenvalues would lose half the digits.
    With few samples of many dimensions the distance is biased upwards: compare it with that of two
    sets of the same kind and size.
    """
    _require_samples(one, other)
    apart = one.mean(axis=0) - other.mean(axis=0)
    first, second = (
        np.linalg.qr(samples - samples.mean(axis=0), mode="r") / np.sqrt(len(samples) - 1)
        for samples in (one, other)
    )
    spread = np.square(first).sum() + np.square(second).sum()
    # Rounding can make a zero distance negative.
    return max(float(apart @ apart + spread - 2 * np.linalg.norm(first @ second.T, "nuc")), 0.0)


def kernel_distance(
    one: Floats, other: Floats, *, size: int, subsets: int, seed: int
) -> tuple[float, float]:
    """Return mean and standard deviation of the squared kernel distance of features (n, d), (m, d).

    It is taken over random subsets of `size` samples of each set, half of the set at most. Each is
    the unbiased estimate with kernel (x y / d + 1)^3 (Binkowski et al., 2018): for sets of the same
    kind it is near zero, and negative as often as positive.
    """
    _require_samples(one, other)
    size = max(min(size, len(one) // 2, len(other) // 2), 2)
    chance = np.random.default_rng(seed)
    distances = [
        squared_kernel_distance(
            one[chance.choice(len(one), size, replace=False)],
            other[chance.choice(len(other), size, replace=False)],
        )
        for _ in range(subsets)
    ]
    return float(np.mean(distances)), float(np.std(distances))


def squared_kernel_distance(one: Floats, other: Floats) -> float:
    """Return the unbiased squared maximum mean discrepancy of features (n, d), (m, d)."""
    _require_samples(one, other)

    def within(samples: Floats) -> float:
        kernel = _kernel(samples, samples)
        count = len(samples)
        return float((kernel.sum() - np.trace(kernel)) / (count * (count - 1)))

    return within(one) + within(other) - 2 * float(_kernel(one, other).mean())


def _kernel(one: Floats, other: Floats) -> Floats:
    return np.asarray((one @ other.T / one.shape[1] + 1) ** DEGREE, np.float64)


def _require_samples(one: Floats, other: Floats) -> None:
    if one.ndim != 2 or one.shape[1:] != other.shape[1:] or min(len(one), len(other)) < 2:
        raise LearningError(
            f"features: found {one.shape} and {other.shape}; allowed: (n, d) and (m, d), 2 "
            "samples or more"
        )
    if not (np.isfinite(one).all() and np.isfinite(other).all()):
        raise LearningError("features: found some that are not numbers; allowed: numbers")


# Separability of two sets of features: by neighbours, and by t-SNE plots.

# Number of neighbours of each sample in the mixing score.
NEIGHBOURS = 10
# Perplexity of t-SNE; a third of the samples if there are fewer than 90.
PERPLEXITY = 30.0


def mixing_score(one: Floats, other: Floats, neighbours: int = NEIGHBOURS) -> float:
    """Return the mixing of two sets of features (n, d), (m, d): 1 is full, 0 none.

    For each sample, take the fraction of its k nearest neighbours, by Euclidean distance, that
    belong to the other set, over the fraction expected by chance (m / (n + m - 1) for samples of
    the first). The score is the mean of both sets' means. Random fluctuation takes it to either
    side of 1.
    """
    _require_samples(one, other)
    features = np.concatenate([one, other]).astype(np.float64)
    which = np.repeat([0, 1], [len(one), len(other)])
    if len(features) <= neighbours:
        raise LearningError(
            f"features: found {len(features)} samples; allowed: more than {neighbours} neighbours"
        )
    square = np.square(features).sum(axis=1)
    apart = square[:, None] + square[None] - 2 * features @ features.T
    np.fill_diagonal(apart, np.inf)
    nearest = np.argpartition(apart, neighbours - 1, axis=1)[:, :neighbours]
    foreign = (which[nearest] != which[:, None]).mean(axis=1)
    counts = np.array([len(one), len(other)])
    expected = counts[::-1] / (counts.sum() - 1)
    return float(np.mean([foreign[which == kind].mean() / expected[kind] for kind in (0, 1)]))


def embedded(features: Floats, *, seed: int) -> Floats:
    """Return t-SNE coordinates (n, 2) of features (n, d).

    Features are standardised, and t-SNE starts from principal components, so that a seed determines
    the plot. A plot proves nothing; `mixing_score` quantifies it.
    """
    from sklearn.manifold import TSNE

    if len(features) < 4:
        raise LearningError(f"features: found {len(features)} samples; allowed: 4 or more")
    spread = features.std(axis=0)
    level = (features - features.mean(axis=0)) / np.where(spread > 0, spread, 1)
    perplexity = min(PERPLEXITY, len(features) / 3)
    projection = TSNE(perplexity=perplexity, init="pca", random_state=seed)
    return np.asarray(projection.fit_transform(level), np.float64)
