"""Testimony of a witness, and how doubtful it is."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.findings import Finding


@dataclass(frozen=True, slots=True)
class Testimony:
    """The most doubtful place that a witness has seen."""

    doubt: float
    """Value seen over the threshold; NaN if it cannot be told."""
    finding: Finding
    """Words for a value above the threshold."""

    @property
    def doubtful(self) -> bool:
        """True above the threshold."""
        return self.doubt > 1.0


def worst(found: Sequence[tuple[float, str]], code: str, where: str) -> Iterator[Testimony]:
    """Yield the testimony of the most doubtful of several places with their words."""
    yield from most([doubt for doubt, _ in found], code, where, lambda k: found[k][1])


def most(
    doubt: Sequence[float] | NDArray[Any], code: str, where: str, text: Callable[[int], str]
) -> Iterator[Testimony]:
    """Yield the testimony of the most doubtful of several places (n,), if there is one.

    `text` describes the doubtful one, by its index.
    """
    some = np.asarray(doubt, np.float64)
    if not some.size:
        return
    worst = int(np.argmax(np.nan_to_num(some, nan=-np.inf)))
    count = int((some > 1.0).sum())
    more = f" (and {count - 1} more like it)" if count > 1 else ""
    yield Testimony(float(some[worst]), Finding(code, where, text(worst) + more))
