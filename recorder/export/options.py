"""What the person who exports may choose, and how a format reports how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

Progress = Callable[[int, int], None]
"""Called with the rows done and those to do."""


@dataclass(frozen=True, slots=True)
class Options:
    """Choices; a format ignores those that do not concern it."""

    decode: bool = False
    """hdf5: store images as pixels instead of the camera's own JPEG bytes."""
    valid_only: bool = False
    """lerobot, genforce: leave out rows that lack a sample near enough."""


def ignored(done: int, total: int) -> None:
    """Report to nobody."""
