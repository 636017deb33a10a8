"""What an effect declares of itself, so that its absence can be proved and its cost be read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Per = Literal[
    "environment", "node", "element", "Gauss point", "contact point",
    "branch and element", "branch and Gauss point",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Memory:
    """An array that the `fem` tier keeps for an effect; of length zero when the effect is off."""

    name: str
    """Path of the attribute, from the solver's `State`."""
    per: Per
    """What the array has a place for."""
    numbers: int
    """Numbers at each place."""


@dataclass(frozen=True, slots=True)
class Snippet:
    """Where lines of an effect stand in kernels: a kernel factory and its flag.

    In the factory's source they are the blocks `if wp.static(FLAG):`, without an `else`: cut out,
    what is left is the kernel without the effect.
    """

    module: str
    """Module of the factory."""
    factory: str
    """Name of the factory."""
    flag: str
    """The factory's argument that compiles them in."""
    user: str = "sim.fem.assembly"
    """Module that calls the factory."""
