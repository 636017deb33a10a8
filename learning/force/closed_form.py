"""Force models in closed form: ridge regression on features of a frame, with a kernel or without.

They learn in seconds from few frames, and are what a network must at least reach. A frame is the
marker field (dx, dy, growth) or the shading (red, green, blue) relative to no contact; its features
are 11 statistics, or means on a grid of cells, to which a kernel adds the likeness of a frame to
some that were learned; or none, for the mean of the labels. Penalties are fixed, or those that
predict groups of frames best that were left out, such as the frames of an indenter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from learning.data.presses import ForceRange, Presses
from learning.force.model import (
    ForceModel,
    ForceNetworkSettings,
    InputSettings,
    prepared_rows,
    require_form,
)

Floats = NDArray[np.float64]
Features = Literal["mean", "statistics", "grid", "kernel"]

# Inputs by form of a frame.
INPUTS = {
    "field": InputSettings(form="field", alone=True),
    "shading": InputSettings(form="shading", side_px=32, alone=True),
}
# Cells along either side of the grid.
CELLS = 8
# Step of a plane, as the network takes it, that counts as large; percentile of the steps.
LARGE, PERCENTILE = 0.1, 0.99
# Number of groups; penalty of statistics, and those that are tried for others, over the number of
# frames.
GROUPS, FIXED, PENALTIES = 4, 0.03, (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
# Directions and frames of the kernel; its widths are tried, over the typical distance of frames.
DIRECTIONS, CENTRES, WIDTHS = 8, 150, (0.5, 1.0, 2.0)
_AT_ONCE = 512


def statistics(frames: Tensor, form: str) -> Tensor:
    """Return 11 features (n, 11) of prepared frames (n, 3, 32, 32).

    By plane the spread and the mean step from place to place; then the part of the view that has
    large steps, and their 99th percentile. Of marker fields also the mean by plane, which is shear;
    of shading the spread of the steps, as mean colours follow the light and the camera.
    """
    flat, step = frames.flatten(2), steps(frames).flatten(2)
    mean = step.mean(dim=1)
    at = PERCENTILE * (mean.shape[1] - 1)
    above = torch.topk(mean, mean.shape[1] - int(at), dim=1).values
    percentile = above[:, -1] + (at - int(at)) * (above[:, -2] - above[:, -1])
    third = flat.mean(dim=2) if form == "field" else step.std(dim=2, correction=0)
    part = (mean > LARGE).to(flat.dtype).mean(dim=1)
    parts = (flat.std(dim=2, correction=0), step.mean(dim=2), third)
    return torch.cat((*parts, part[:, None], percentile[:, None]), dim=1)


def steps(frames: Tensor) -> Tensor:
    """Return the size of the step to the next row and column (n, 3, h - 1, w - 1) of frames."""
    here = frames[..., :-1, :-1]
    down, across = frames[..., 1:, :-1] - here, frames[..., :-1, 1:] - here
    return torch.sqrt(down.square() + across.square() + 1e-12)


def cells(frames: Tensor, form: str) -> Tensor:
    """Return means on a grid (n, 192) of frames (n, 3, 32, 32); of shading, means of its steps."""
    planes = frames if form == "field" else functional.pad(steps(frames), (0, 1, 0, 1))
    return functional.avg_pool2d(planes, frames.shape[-1] // CELLS).flatten(1)


@dataclass(frozen=True, slots=True)
class ClosedFormSettings:
    """Features of a model in closed form, and their number."""

    features: Features
    columns: int
    """Number of features of a frame."""
    centres: int = 0
    """Number of learned frames that a kernel compares with."""


class ClosedFormModel(ForceModel):
    """Forces of single frames by a linear map of features; it keeps no state."""

    centre: Tensor
    scale: Tensor
    directions: Tensor
    centres: Tensor

    def __init__(self, settings: ClosedFormSettings, inputs: InputSettings) -> None:
        """Build a model that predicts 0 N."""
        nn.Module.__init__(self)
        self.settings, self.inputs, self.network = settings, inputs, ForceNetworkSettings()
        many, own = settings.centres, settings.columns
        shapes = {
            "low": (3,),
            "high": (3,),
            "centre": (own,),
            "scale": (own,),
            "directions": (own, min(DIRECTIONS, own) if many else 0),
            "centres": (many, min(DIRECTIONS, own) if many else 0),
        }
        for name, shape in shapes.items():
            ones = name in ("high", "scale")
            self.register_buffer(name, torch.ones(shape) if ones else torch.zeros(shape))
        # Parameters, as a model's precision is that of its first one; solved, never descended.
        self.weights = nn.Parameter(torch.zeros(own + many, 3), requires_grad=False)
        self.offset = nn.Parameter(torch.zeros(3), requires_grad=False)

    @property
    def state_shape(self) -> tuple[int, int, int]:
        """Shape of a state that says nothing."""
        return 1, 1, 1

    def initial_state(self, batch: int) -> Tensor:
        """Return a state (batch, 1, 1, 1) of zeros."""
        return self.low.new_zeros(batch, *self.state_shape)

    def forward(
        self, frames: Tensor, state: Tensor | None = None, *, lengths: Sequence[int] | None = None
    ) -> tuple[Tensor, Tensor]:
        """Return forces (b, s, 3), 0 to 1 within the range of training, and a state of zeros."""
        forces = self._forces(frames.flatten(0, 1)).view(*frames.shape[:2], 3)
        return forces, self.initial_state(len(frames))

    def step(self, frame: Tensor, state: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Return forces (b, 3), 0 to 1 within the range of training, and the state as it was."""
        before = self.initial_state(len(frame)) if state is None else state
        return self._forces(frame), before * 0.0

    def features(self, frames: Tensor) -> Tensor:
        """Return the features (n, columns) of prepared frames (n, 3, h, w)."""
        if self.settings.features == "mean":
            return frames.new_zeros(len(frames), 1)
        if self.settings.features == "statistics":
            return statistics(frames, self.inputs.form)
        return cells(frames, self.inputs.form)

    def spread(self, features: Tensor) -> Tensor:
        """Return standardised features, with the likeness to learned frames (n, columns + k)."""
        standard = (features - self.centre) / self.scale
        if not self.settings.centres:
            return standard
        apart = (standard @ self.directions)[:, None] - self.centres
        return torch.cat((standard, torch.exp(-0.5 * apart.square().sum(dim=2))), dim=1)

    def _forces(self, frames: Tensor) -> Tensor:
        return self.spread(self.features(frames)) @ self.weights + self.offset


def features_of(presses: Presses, features: Features) -> Tensor:
    """Return the features (n, m) of all frames of presses, marker fields or shading, on the CPU."""
    inputs = INPUTS[presses.form]
    require_form(presses, inputs)
    empty = ClosedFormModel(ClosedFormSettings(features, 1), inputs)
    rows = torch.arange(presses.frames).split(_AT_ONCE)
    return torch.cat(
        [empty.features(prepared_rows(presses, r.to(presses.device), inputs).cpu()) for r in rows]
    ).double()


def fit_closed_form(presses: Presses, features: Features) -> ClosedFormModel:
    """Return the model of labelled presses of a sensor, marker fields or shading.

    The groups that are left out to choose penalties are some of its indenters, or of its presses if
    it has one indenter.
    """
    presses.require_wrench()
    inputs = INPUTS[presses.form]
    values = features_of(presses, features)
    indenter = presses.indenter[presses.of_frame].numpy()
    of = indenter if len(np.unique(indenter)) > 1 else presses.of_frame.numpy()
    groups = np.unique(of, return_inverse=True)[1] % GROUPS
    box = ForceRange.from_training(presses.wrench.cpu())
    best: tuple[float, ClosedFormModel] | None = None
    for width in WIDTHS if features == "kernel" else (0.0,):
        model = _prepared(values, features, inputs, width)
        model.set_range(box)
        labels = model.normalised(presses.wrench.cpu()).double().numpy()
        off = _solve(model, model.double().spread(values).numpy(), labels, groups)
        if best is None or off < best[0]:
            best = off, model.float()
    assert best is not None
    return best[1].eval()


def _prepared(
    values: Tensor, features: Features, inputs: InputSettings, width: float
) -> ClosedFormModel:
    """Return a model without weights, whose features (n, m) are standardised."""
    many = min(CENTRES, len(values)) if width else 0
    model = ClosedFormModel(ClosedFormSettings(features, values.shape[1], many), inputs).double()
    scale = values.std(dim=0, correction=0)
    # Features of one kind keep their proportions: a cell that hardly moves says little.
    scale = scale if features == "statistics" else torch.full_like(scale, float(scale.mean()))
    model.centre.copy_(values.mean(dim=0))
    model.scale.copy_(torch.where(scale > 0, scale, torch.ones_like(scale)))
    if many:
        standard = (values - model.centre) / model.scale
        _, _, axes = torch.linalg.svd(standard, full_matrices=False)
        directions = axes[: model.directions.shape[1]].T
        typical = float((standard @ directions).square().sum(dim=1).mean().sqrt()) or 1.0
        model.directions.copy_(directions / (width * typical))
        chosen = np.linspace(0, len(values) - 1, many).round().astype(int)
        model.centres.copy_(standard[chosen] @ model.directions)
    return model


def _solve(model: ClosedFormModel, rows: Floats, labels: Floats, groups: NDArray[Any]) -> float:
    """Set the weights for features (n, m) and normalised labels (n, 3); return the error left out.

    Each axis has its own penalty. The error is the mean square of labels, in the range of training.
    """
    tried = PENALTIES if model.settings.features in ("grid", "kernel") else (FIXED,)
    known, errors = np.isfinite(labels), []
    # Axes with labels in the same frames are solved together.
    for mask in np.unique(known, axis=1).T:
        axes = np.flatnonzero((known == mask[:, None]).all(axis=0))
        if not mask.any():
            continue
        own, wanted, of = rows[mask], labels[mask][:, axes], groups[mask]
        off = np.zeros((len(tried), len(axes)))
        every = np.unique(of)
        for group in every if min(len(every), len(tried)) > 1 else ():
            inside = of == group
            for number, (weights, offset) in enumerate(ridge(own[~inside], wanted[~inside], tried)):
                apart = own[inside] @ weights + offset - wanted[inside]
                off[number] += np.square(apart).sum(axis=0)
        best = off.argmin(axis=0) if off.any() else np.full(len(axes), len(tried) // 2)
        solved = ridge(own, wanted, tried)
        for column, (axis, number) in enumerate(zip(axes, best, strict=True)):
            weights, offset = solved[number]
            model.weights[:, axis] = torch.from_numpy(weights[:, column].copy())
            model.offset[axis] = float(offset[column])
            errors.append(off[number, column] / len(own))
    return float(np.mean(errors))


def ridge(rows: Floats, wanted: Floats, penalties: Sequence[float]) -> list[tuple[Floats, Floats]]:
    """Return weights (m, k) and offsets (k,) by each penalty, of features (n, m), labels (n, k)."""
    middle, mean = rows.mean(axis=0), wanted.mean(axis=0)
    inside = rows - middle
    values, vectors = np.linalg.eigh(inside.T @ inside)
    right = vectors.T @ (inside.T @ (wanted - mean))
    found = []
    for penalty in penalties:
        weights = vectors @ (right / (values.clip(min=0) + penalty * len(rows))[:, None])
        found.append((weights, mean - middle @ weights))
    return found
