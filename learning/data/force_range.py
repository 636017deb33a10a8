"""The box of forces that a model answers in: its last layer gives numbers from 0 to 1.

The paper normalises by the least and greatest force of each axis (Methods); the authors' code has
fixed ones. Ours come from the training split and are stored with the model.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError

Force = tuple[float, float, float]
Values = TypeVar("Values", bound=Any)

LEAST = 1e-3
"""An axis along which forces differ by less [N] is widened to this: it carries no signal."""


@dataclass(frozen=True, slots=True)
class ForceRange:
    """Least and greatest force of each axis."""

    low: Force
    """Fx, Fy, Fz [N] that become 0."""
    high: Force
    """Fx, Fy, Fz [N] that become 1."""

    def __post_init__(self) -> None:
        ends = np.array([self.low, self.high], np.float64)
        if ends.shape != (2, 3) or not np.isfinite(ends).all() or (ends[0] >= ends[1]).any():
            raise LearningError(
                f"force range: found {self.low} to {self.high}; allowed: three finite forces [N] "
                "each, low < high"
            )

    @classmethod
    def from_training(cls, wrench: Any, *, margin: float = 0.0) -> ForceRange:
        """Return the range of forces (n, 3) or wrenches (n, 6) [N], an array or a tensor.

        Args:
            wrench: Those of the training split.
            margin: Share of the range that is added at both ends: a sigmoid never reaches its own.

        Raises:
            LearningError: None, NaN among them, or a negative margin.
        """
        forces: NDArray[np.float64] = np.asarray(
            wrench.cpu() if hasattr(wrench, "cpu") else wrench, np.float64
        )
        if forces.ndim != 2 or forces.shape[1] not in (3, 6) or not len(forces):
            raise LearningError(f"wrench: found {forces.shape}; allowed: (n, 3) or (n, 6), n > 0")
        if margin < 0:
            raise LearningError(f"margin: found {margin}; allowed: 0 and more")
        forces = forces[:, :3]
        if not np.isfinite(forces).all():
            row = int(np.flatnonzero(~np.isfinite(forces).all(axis=1))[0])
            raise LearningError(f"wrench: found {forces[row]} in row {row}; allowed: finite forces")
        low, high = forces.min(axis=0), forces.max(axis=0)
        wider = np.maximum(LEAST - (high - low), 0) / 2 + margin * (high - low)
        return cls(_force(low - wider), _force(high + wider))

    @classmethod
    def from_dict(cls, stored: Mapping[str, Any]) -> ForceRange:
        """Return the range that `to_dict` wrote.

        Raises:
            LearningError: Not such a mapping.
        """
        try:
            low, high = (tuple(map(float, stored[end])) for end in ("low", "high"))
        except (KeyError, TypeError, ValueError) as error:
            raise LearningError(f"force range: found {stored!r}; allowed: low, high") from error
        return cls(low, high)  # type: ignore[arg-type]

    def to_dict(self) -> dict[str, list[float]]:
        """Return plain values for a file."""
        return {"low": list(self.low), "high": list(self.high)}

    def normalise(self, force: Values) -> Values:
        """Return forces (..., 3) [N], an array or a tensor, as numbers that are 0 to 1 inside."""
        low = _like(force, self.low)
        shares: Values = (force - low) / (_like(force, self.high) - low)
        return shares

    def denormalise(self, numbers: Values) -> Values:
        """Return numbers (..., 3) as forces [N]."""
        low = _like(numbers, self.low)
        forces: Values = numbers * (_like(numbers, self.high) - low) + low
        return forces


AUTHORS = ForceRange((-5.0, -5.0, -20.0), (5.0, 5.0, 5.0))
"""The range in the authors' code."""


def _like(values: Any, ends: Force) -> Any:
    """Return the ends of a range as what is calculated with."""
    if isinstance(values, np.ndarray):
        return np.asarray(ends, values.dtype)
    return values.new_tensor(ends)


def _force(values: NDArray[np.float64]) -> Force:
    x, y, z = (float(value) for value in values)
    return x, y, z
