"""Many scenes on a device: side by side where that is faster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from sim.scene import Scene

Outcome = TypeVar("Outcome")


def in_launches(
    solve: Callable[[Sequence[Scene], str], list[Outcome]], scenes: Sequence[Scene], device: str
) -> list[Outcome]:
    """What `solve` gives for `scenes`: all in one launch on a GPU, one by one on a CPU.

    A CPU computes one thing after the other in any case; a launch of many only makes the quick
    ones wait for the slow ones.
    """
    if device != "cpu":
        return solve(scenes, device)
    return [outcome for scene in scenes for outcome in solve([scene], device)]
