"""Solve many scenes on a device, in parallel where that is faster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

from sim.scene import Scene

Outcome = TypeVar("Outcome")


def in_launches(
    solve: Callable[[Sequence[Scene], str], list[Outcome]], scenes: Sequence[Scene], device: str
) -> list[Outcome]:
    """Return the results of `solve` for `scenes`: one launch on a GPU, one by one on a CPU.

    A CPU computes sequentially in any case, so a launch of many scenes only makes the fast ones
    wait for the slow ones.
    """
    if device != "cpu":
        return solve(scenes, device)
    return [outcome for scene in scenes for outcome in solve([scene], device)]
