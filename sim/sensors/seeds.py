"""Random numbers that depend on a seed and on names alone, never on what was drawn before."""

from __future__ import annotations

import zlib

import numpy as np

from sim.errors import SceneError


def generator(seed: int, *names: str | int) -> np.random.Generator:
    """The random numbers of whatever `names` name, under this seed.

    Equal seeds and names give equal numbers, in any process and any order; others give numbers
    that have nothing to do with them (NumPy's `SeedSequence` with the names as its spawn key).

    Raises:
        SceneError: A seed or a number among the names that is below 0.
    """
    numbers = [name for name in (seed, *names) if not isinstance(name, str)]
    if any(number < 0 for number in numbers):
        raise SceneError(f"seed: {seed!r}, names {names!r}; allowed: numbers from 0")
    # A name's length keeps ("a", 1) apart from a text whose checksum happens to be 1.
    key: list[int] = []
    for name in names:
        if isinstance(name, str):
            key += [1 + len(name), zlib.crc32(name.encode())]
        else:
            key += [0, name]
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=tuple(key)))
