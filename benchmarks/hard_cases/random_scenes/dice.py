"""Reproducible random numbers, determined by seed, scene, and the order of drawing."""

import random
from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate
from typing import TypeVar

Item = TypeVar("Item")


class Dice:
    """Random stream of one scene, which uses only the stable `random.Random.random`.

    `words` describe the scene: the families and kinds that were drawn.
    """

    def __init__(self, seed: int, scene: int, attempt: int = 0) -> None:
        """Create the stream of scene `scene` of `seed`."""
        self.words: list[str] = []
        self._draw = random.Random(f"hard cases {seed}/{scene}/{attempt}").random

    def chance(self, fraction: float) -> bool:
        """Return True with probability `fraction`."""
        return self._draw() < fraction

    def even(self, low: float, high: float) -> float:
        """Return a uniform number between `low` and `high`."""
        return rounded(low + (high - low) * self._draw())

    def scaled(self, low: float, high: float) -> float:
        """Return a log-uniform number between `low` and `high` (both above 0)."""
        return rounded(low * (high / low) ** self._draw())

    def whole(self, low: int, high: int) -> int:
        """Return a uniform integer from `low` to `high`, both included."""
        return low + min(int(self._draw() * (high - low + 1)), high - low)

    def one_of(self, items: Sequence[Item]) -> Item:
        """Return one of the items."""
        return items[self.whole(0, len(items) - 1)]

    def kind(self, items: dict[str, float]) -> str:
        """Return a key as `weighted`, which becomes one of the words."""
        self.words.append(self.weighted(items))
        return self.words[-1]

    def weighted(self, items: dict[Item, float]) -> Item:
        """Return a key with a probability proportional to its weight."""
        ends = list(accumulate(items.values()))
        return list(items)[bisect_right(ends, self._draw() * ends[-1], hi=len(ends) - 1)]


def rounded(value: float, digits: int = 3) -> float:
    """Return the value with this number of significant digits, so that it can be typed."""
    return float(f"{value:.{digits - 1}e}")
