"""What crosses between the collecting process and the page's: small, frozen, picklable."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rig.acquire.request import Order
from rig.bench.bench import Bench
from rig.monitor.page.access import Gate
from trajectories import Plan, PressShear

Outcome = Literal["open", "done", "limited"]

# One letter a target on the wire.
LETTERS: dict[Outcome, str] = {"open": ".", "done": "d", "limited": "l"}
# What the page may ask for.
COMMANDS = ("pause", "resume", "abort")
# Statuses after which nothing follows.
ENDED = ("complete", "stopped", "gone")


@dataclass(frozen=True, slots=True)
class Spot:
    """One target on the map."""

    point: int
    """Number of its contact point."""
    x: float
    """Place of the point in the contact frame [m]."""
    y: float
    """The same along y [m]."""
    depth: float
    """Indentation [m]."""
    direction: int
    """Shear direction, counter-clockwise from +x; -1 without shear."""


@dataclass(frozen=True, slots=True)
class PageJob:
    """What the page's process needs to know from the start."""

    gate: Gate
    """Where to listen, whom to let in."""
    bench: Bench
    """Whose streams and limits are shown."""
    folder: Path
    """Run folder, where `<stream>.latest` and `<stream>.counters` will appear."""
    session: Path
    """Session that will be written."""
    spots: tuple[Spot, ...]
    """The map, target by target."""
    directions: int
    """Shear directions of the plan; 1 without shear."""
    indenter: str
    """Name of the indenter on the arm."""
    patience: float = 5.0
    """A client that takes nothing for so long is let go [s]."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """How far the collection is; the page's process gets one a few times a second."""

    status: str = "preparing"
    """preparing, collecting, paused, ending, or one of ENDED."""
    reason: str = ""
    """Why it ended, or where the result lies."""
    target: int = -1
    """Index of the target under way; -1 before the first and after the last."""
    phase: str = ""
    """What the arm is doing, in words."""
    outcomes: str = ""
    """One of LETTERS for every target."""
    left: float | None = None
    """Time left [s], once it can be said."""
    elapsed: float = 0.0
    """Time since the collection was started [s]."""
    paused_by: tuple[str, ...] = ()
    """Who wants a pause."""
    log: tuple[str, ...] = ()
    """Log lines since the snapshot before."""


def page_job(
    gate: Gate, bench: Bench, folder: Path, order: Order, plan: Plan, total: int
) -> PageJob:
    """The job for a collection of the first `total` targets of `plan`."""
    spots = tuple(
        Spot(target.point, *target.origin[:2], target.depth, target.direction)
        for target in plan.targets()
        if target.index < total
    )
    directions = plan.direction_count if isinstance(plan, PressShear) else 1
    return PageJob(gate, bench, folder, order.path, spots, directions, bench.indenter)
