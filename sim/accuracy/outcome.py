"""What of a result is compared, and kept in a file to compare with later."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.body import Body
from sim.result import Result

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Outcome:
    """Force, surface and touched points of F frames; SI units, contact frame."""

    force: Array
    """Of the indenter on the body (F, 3) [N]."""
    surface_x: Array
    """x of the material points of the top (X,) [m], rising, evenly spaced or not."""
    surface_y: Array
    """The same for y (Y,) [m]."""
    surface: NDArray[np.float32]
    """Displacement of those points (F, X, Y, 3) [m]."""
    touched: NDArray[np.bool_]
    """Which of them feel traction (F, X, Y)."""

    def frames(self, chosen: list[int]) -> Outcome:
        """The same with these frames only."""
        return Outcome(
            self.force[chosen],
            self.surface_x,
            self.surface_y,
            self.surface[chosen],
            self.touched[chosen],
        )


def outcome_of(result: Result) -> Outcome:
    """What is compared of `result`; no traction (NaN) counts as not touched."""
    return Outcome(
        force=np.asarray(result.force, np.float64),
        surface_x=result.surface_x,
        surface_y=result.surface_y,
        surface=result.surface,
        touched=np.asarray((np.abs(result.traction) > 0).any(axis=-1)),
    )


def save(path: Path, outcomes: dict[str, Outcome]) -> None:
    """Write outcomes under their names to one `.npz`, whole or not at all."""
    arrays = {}
    for name, one in outcomes.items():
        for field in Outcome.__slots__:
            arrays[f"{name}/{field}"] = getattr(one, field)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.partial.npz")
    with partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    partial.replace(path)


def load(path: Path) -> dict[str, Outcome]:
    """The outcomes that `save` wrote.

    Raises:
        FileNotFoundError: There is no such file.
    """
    with np.load(path) as kept:
        names = sorted({key.rpartition("/")[0] for key in kept.files})
        return {
            name: Outcome(**{field: kept[f"{name}/{field}"] for field in Outcome.__slots__})
            for name in names
        }


def check_same(one: Outcome, other: Outcome, body: Body) -> None:
    """Refuse what cannot be compared.

    Raises:
        ValueError: Unlike numbers of frames, or points beyond the body.
    """
    if len(one.force) != len(other.force):
        raise ValueError(f"{len(one.force)} frames against {len(other.force)} of the reference")
    for outcome in (one, other):
        for places, size in ((outcome.surface_x, body.size_x), (outcome.surface_y, body.size_y)):
            if np.abs(places).max() > 0.501 * size:
                raise ValueError(f"points up to {np.abs(places).max()} m on a body of {size} m")
