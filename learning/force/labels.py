"""The forces that a model learns to say: labels, changed for another material, and their box."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from learning.data.force_range import AUTHORS, ForceRange
from learning.data.presses import Presses
from learning.errors import LearningError
from learning.force.settings import ForceSettings

Compensation = Callable[
    [NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]],
    tuple[NDArray[np.float64], int],
]
"""From forces (N, 3) N, depth (N,) m and phase (N,) to forces as the target's material would give
them, and how many were limited: `learning.compensation` with its sensors and numbers filled in."""


def labels_of(presses: Presses, compensation: Compensation | None = None) -> Tensor:
    """Return the forces (N, 3) N that presses are learned with, on their device.

    Raises:
        LearningError: A frame has no label, or compensation makes one that is no number.
    """
    presses.require_wrench()
    if compensation is None:
        return presses.wrench[:, :3]
    forces = presses.wrench[:, :3].double().cpu().numpy()
    changed, _ = compensation(forces, presses.depth.cpu().numpy(), presses.phase.cpu().numpy())
    if changed.shape != forces.shape or not np.isfinite(changed).all():
        raise LearningError(
            f"compensation of {presses.sensor}: found forces {changed.shape} that are not all "
            f"finite; allowed: {forces.shape}, finite"
        )
    return torch.from_numpy(changed).float().to(presses.device)


def force_range(labels: Sequence[Tensor], settings: ForceSettings) -> ForceRange:
    """Return the box of forces that a model answers in.

    Where images are mirrored, shear has both signs, and so has the box.
    """
    if settings.force_range == "authors":
        return AUTHORS
    forces = torch.cat([each.cpu() for each in labels])
    if settings.sequences.flips:
        forces = torch.cat([forces, forces * forces.new_tensor([-1.0, -1.0, 1.0])])
    return ForceRange.from_training(forces, margin=settings.range_margin)
