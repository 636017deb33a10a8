"""Numbers drawn by chance that stay the same forever: by seed, scene, and the order of drawing."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from typing import TypeVar

Item = TypeVar("Item")

# Significant digits of what is drawn, so that a scene can be read and typed.
DIGITS = 3


class Dice:
    """A stream of numbers for one scene; only `random.Random.random`, which Python keeps as is."""

    def __init__(self, seed: int, scene: int) -> None:
        """The stream of scene `scene` of `seed`."""
        self._draw = random.Random(f"hard cases {seed}/{scene}").random

    def chance(self, share: float) -> bool:
        """True in `share` of the throws."""
        return self._draw() < share

    def even(self, low: float, high: float) -> float:
        """A number between `low` and `high`, all alike."""
        return rounded(low + (high - low) * self._draw())

    def scaled(self, low: float, high: float) -> float:
        """A number between `low` and `high` (both above 0), every decade alike."""
        return rounded(low * (high / low) ** self._draw())

    def whole(self, low: int, high: int) -> int:
        """A whole number from `low` to `high`, both included."""
        return low + min(int(self._draw() * (high - low + 1)), high - low)

    def one_of(self, items: Sequence[Item]) -> Item:
        """One of the items."""
        return items[self.whole(0, len(items) - 1)]

    def weighted(self, items: dict[Item, float]) -> Item:
        """A key, as often as its weight says."""
        left = self._draw() * sum(items.values())
        for item, weight in items.items():
            left -= weight
            if left < 0:
                return item
        return list(items)[-1]

    def signed(self, size: float) -> float:
        """The size, or less than nothing of it."""
        return size if self._draw() < 0.5 else -size


def rounded(value: float, digits: int = DIGITS) -> float:
    """The value with so many significant digits."""
    if value == 0 or not math.isfinite(value):
        return value
    return float(f"{value:.{digits - 1}e}")
