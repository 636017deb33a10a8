"""Messages between the collecting process and the page's: small, frozen, picklable."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rig.acquire.request import CollectRequest
from rig.bench.bench import Bench
from rig.monitor.page.access import AccessPolicy
from trajectories import Plan, PressShear, dome_height

Outcome = Literal["open", "done", "limited"]

# Letter of a target's outcome in messages.
LETTERS: dict[Outcome, str] = {"open": ".", "done": "d", "limited": "l"}
# Commands of the page.
COMMANDS = ("pause", "resume", "abort")
# Final statuses.
ENDED = ("complete", "stopped", "gone")


@dataclass(frozen=True, slots=True)
class Spot:
    """Target on the map."""

    point: int
    """Number of its contact point."""
    x: float
    """x of the point in the contact frame [m]."""
    y: float
    """y of the point [m]."""
    depth: float
    """Indentation [m]."""
    direction: int
    """Shear direction, counter-clockwise from +x; -1 without shear."""


@dataclass(frozen=True, slots=True)
class PageJob:
    """Settings of the page's process."""

    access: AccessPolicy
    """Address to listen on, and access policy."""
    bench: Bench
    """Bench whose streams and limits are shown."""
    folder: Path
    """Run folder for `<stream>.latest` and `<stream>.counters`."""
    session: Path
    """Session to be written."""
    spots: tuple[Spot, ...]
    """Targets on the map."""
    directions: int
    """Shear directions of the plan; 1 without shear."""
    indenter: str
    """Name of the indenter on the arm."""
    clearance: float
    """Height above the surface at which the tip waits before a press [m]."""
    patience: float = 5.0
    """Time after which a client that reads nothing is disconnected [s]."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Progress of the collection, sent to the page's process a few times per second."""

    status: str = "preparing"
    """preparing, collecting, paused, ending, or one of ENDED."""
    reason: str = ""
    """Reason of the end, or location of the result."""
    target: int = -1
    """Index of the current target; -1 before the first and after the last."""
    phase: str = ""
    """Current activity of the arm, as text."""
    outcomes: str = ""
    """One of LETTERS for every target."""
    left: float | None = None
    """Estimated remaining time [s], None before it is known."""
    elapsed: float = 0.0
    """Time since the collection was started [s]."""
    paused_by: tuple[str, ...] = ()
    """Sources of the current pause requests."""
    log: tuple[str, ...] = ()
    """Log lines since the previous snapshot."""


def page_job(
    access: AccessPolicy,
    bench: Bench,
    folder: Path,
    request: CollectRequest,
    plan: Plan,
    total: int,
) -> PageJob:
    """Return the page's settings for a collection of the first `total` targets of `plan`."""
    targets = [target for target in plan.targets() if target.index < total]
    spots = tuple(
        Spot(target.point, *target.origin[:2], target.depth, target.direction) for target in targets
    )
    radius = bench.dome_radius
    heights = [t.origin[2] - dome_height(radius, *t.origin[:2]) for t in targets]
    directions = plan.direction_count if isinstance(plan, PressShear) else 1
    indenter, clearance = bench.indenter, min(heights, default=0.0)
    return PageJob(access, bench, folder, request.path, spots, directions, indenter, clearance)
