"""The statistics that LeRobot keeps of each feature, gathered episode by episode."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Array = np.ndarray[Any, Any]
Floats = NDArray[np.float64]

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
"""Quantiles by their names in LeRobot."""
_SAMPLED = 8  # images of an episode that are looked at
_STRIDE = 4  # pixels


@dataclass(frozen=True, slots=True)
class _Part:
    """Statistics of some rows of one feature."""

    count: int
    low: Floats
    high: Floats
    mean: Floats
    var: Floats
    quantiles: dict[str, Floats]

    def plus(self, other: _Part) -> _Part:
        """Return the statistics of both.

        Moments are exact (Chan et al. 1979); quantiles are the mean of both weighted by their
        counts, as LeRobot itself does.
        """
        total = self.count + other.count
        share = other.count / total
        shift = other.mean - self.mean
        return _Part(
            total,
            np.fmin(self.low, other.low),
            np.fmax(self.high, other.high),
            self.mean + share * shift,
            (1 - share) * self.var + share * other.var + share * (1 - share) * shift**2,
            {
                name: (1 - share) * value + share * other.quantiles[name]
                for name, value in self.quantiles.items()
            },
        )

    def document(self) -> dict[str, list[Any]]:
        """Return them as LeRobot writes them."""
        return {
            "min": self.low.tolist(),
            "max": self.high.tolist(),
            "mean": self.mean.tolist(),
            "std": np.sqrt(self.var).tolist(),
            "count": [self.count],
            **{name: value.tolist() for name, value in self.quantiles.items()},
        }


@dataclass(slots=True)
class Stats:
    """Statistics by feature. Rows with a NaN do not count."""

    parts: dict[str, _Part] = field(default_factory=dict)
    """One per feature that had any row."""

    def add(self, name: str, values: Array) -> None:
        """Take in rows (n,) or (n, m) of a feature."""
        rows = np.asarray(values, np.float64).reshape(len(values), -1)
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows):
            self._take(name, _part(rows, len(rows)))

    def add_images(self, name: str, encoded: Sequence[bytes]) -> None:
        """Take in some pixels of some encoded images; values 0 to 1, shape (c, 1, 1)."""
        chosen = np.unique(np.linspace(0, len(encoded) - 1, _SAMPLED).astype(int))
        pixels = []
        for place in chosen:
            with Image.open(io.BytesIO(encoded[place])) as image:
                array = np.asarray(image)[::_STRIDE, ::_STRIDE]
            pixels.append(array.reshape(-1, array.shape[2] if array.ndim == 3 else 1))
        part = _part(np.concatenate(pixels) / 255.0, len(chosen))
        self._take(name, part)
        self._shapes.add(name)

    def merge(self, other: Stats) -> None:
        """Take in all of another."""
        for name, part in other.parts.items():
            self._take(name, part)
        self._shapes |= other._shapes

    def document(self) -> dict[str, dict[str, list[Any]]]:
        """Return what goes into meta/stats.json."""
        return {name: self._shaped(name) for name in self.parts}

    def flat(self) -> dict[str, list[Any]]:
        """Return what goes into an episode's row: `stats/<feature>/<statistic>`."""
        return {
            f"stats/{name}/{key}": value
            for name in self.parts
            for key, value in self._shaped(name).items()
        }

    _shapes: set[str] = field(default_factory=set)

    def _take(self, name: str, part: _Part) -> None:
        self.parts[name] = self.parts[name].plus(part) if name in self.parts else part

    def _shaped(self, name: str) -> dict[str, list[Any]]:
        document = self.parts[name].document()
        if name not in self._shapes:
            return document
        return {
            key: value if key == "count" else [[[entry]] for entry in value]
            for key, value in document.items()
        }


def _part(rows: Floats, count: int) -> _Part:
    cuts = np.quantile(rows, list(QUANTILES.values()), axis=0)
    return _Part(
        count,
        rows.min(axis=0),
        rows.max(axis=0),
        rows.mean(axis=0),
        rows.var(axis=0),
        dict(zip(QUANTILES, cuts, strict=True)),
    )
