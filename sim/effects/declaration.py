"""Declarations of an effect's arrays and kernel code, to state its cost and verify its absence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Per = Literal[
    "environment", "node", "element", "Gauss point", "contact point",
    "branch and element", "branch and Gauss point",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Memory:
    """Array that tier `fem` keeps for an effect; its length is zero when the effect is off."""

    name: str
    """Path of the attribute, relative to the solver's `State`."""
    per: Per
    """Entity that each entry belongs to."""
    numbers: int
    """Number of values per entry."""


@dataclass(frozen=True, slots=True)
class Snippet:
    """Location of an effect's code in kernels: a kernel factory and its flag.

    In the factory's source it consists of the blocks `if wp.static(FLAG):`, without an `else`.
    Removing them gives the kernel without the effect.
    """

    module: str
    """Module of the factory."""
    factory: str
    """Name of the factory."""
    flag: str
    """Argument of the factory that compiles the code in."""
    user: str = "sim.fem.assembly"
    """Module that calls the factory."""
