"""Chance as a pure function of seed and step: what resumes needs to remember nothing.

Every choice has a generator of its own, made from the seed and words that say what is chosen, on
which step, by which process. So a training that was stopped goes on with the same choices, and two
choices that were put in another order stay what they were.
"""

from __future__ import annotations

import functools
import hashlib

import numpy as np
import torch
from numpy.typing import NDArray

from learning.errors import LearningError


def generator(seed: int, *words: str | int) -> np.random.Generator:
    """Return the generator of a choice.

    Args:
        seed: Of the whole training.
        words: What is chosen: names, and numbers such as step and rank.
    """
    return np.random.default_rng(np.random.SeedSequence(_entropy(seed, words)))


def seed_torch(seed: int, *words: str | int) -> None:
    """Seed what networks draw themselves, dropout for instance; call it at the start of a step."""
    torch.manual_seed(_entropy(seed, words) % 2**63)


def batch(
    seed: int, step: int, size: int, count: int, *, rank: int = 0, ranks: int = 1, what: str = ""
) -> NDArray[np.int64]:
    """Return which of `count` things a process sees on a step (size,): passes without repeats.

    All are seen once, in an order of its own, before the next pass begins; a batch may reach from
    one pass into the next. The processes of one step see different parts of the same order.

    Args:
        seed: Of the whole training.
        step: From 0.
        size: Of the batch of one process.
        count: How many things there are.
        rank: Number of the process.
        ranks: How many processes there are.
        what: Name of the choice, where there are several.

    Raises:
        LearningError: Nothing to choose from.
    """
    if count < 1 or size < 1:
        raise LearningError(f"batch: found {size} of {count}; allowed: 1 and more of 1 and more")
    first = (step * ranks + rank) * size
    places = np.arange(first, first + size)
    passes, within = np.divmod(places, count)
    chosen = np.empty(size, np.int64)
    for number in np.unique(passes).tolist():
        here = passes == number
        chosen[here] = _order(seed, what, number, count)[within[here]]
    return chosen


@functools.lru_cache(maxsize=8)
def _order(seed: int, what: str, number: int, count: int) -> NDArray[np.int64]:
    """Return the order of one pass."""
    order = generator(seed, "order", what, number).permutation(count).astype(np.int64)
    order.setflags(write=False)
    return order


def _entropy(seed: int, words: tuple[str | int, ...]) -> int:
    """Return 128 bits that depend on every word and on their order."""
    # Words are told apart by their kind and length, so that ("a", 1) is not ("a1",).
    text = "".join(f"{type(word).__name__} {len(str(word))} {word} " for word in (seed, *words))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little")
