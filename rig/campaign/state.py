"""How far a campaign is. Its sessions are the only memory it has."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from recorder import Session, SessionError
from rig.campaign.spec import Campaign, Item
from rig.collect.live import minutes
from rig.collect.progress import first_open_target
from trajectories import plan_from_json

_OVERHEAD = 20.0
# Preflight, tare, sealing and the swap of an indenter that does not go wrong [s].

State = Literal["done", "to resume", "open", "unreadable"]


@dataclass(frozen=True, slots=True)
class Progress:
    """One session of a campaign, as it is on disk."""

    item: Item
    session: Path
    state: State
    done: int
    """Targets behind it."""
    note: str = ""
    """Why it was stopped, or cannot be read."""

    @property
    def left(self) -> float:
        """Time it still takes, about [s]."""
        if self.state == "done":
            return 0.0
        return _OVERHEAD + self.item.duration * (1 - self.done / self.item.total)


def progress_of(campaign: Campaign) -> list[Progress]:
    """Look at the session of every entry, in order."""
    return [_look(item, campaign.out / f"{item.entry.name}.zarr") for item in campaign.items]


def _look(item: Item, path: Path) -> Progress:
    if not path.exists():
        return Progress(item, path, "open", 0)
    try:
        session = Session(path)
        attrs = session.attrs
        for key, wanted in (("sensor", item.entry.sensor), ("indenter", item.entry.indenter)):
            if attrs.get(key) != wanted:
                note = f"its {key} is {attrs.get(key)!r}: move it away"
                return Progress(item, path, "unreadable", 0, note)
        total = int(attrs["targets_wanted"])
        done = first_open_target(plan_from_json(attrs["plan"]), session.segments, total)
    except (SessionError, OSError, ValueError, KeyError) as error:
        return Progress(item, path, "unreadable", 0, str(error))
    if session.status == "complete" and done == total:
        return Progress(item, path, "done", total)
    return Progress(item, path, "to resume", done, str(attrs.get("reason", "")))


def table(found: list[Progress]) -> list[str]:
    """What is done and what is left, one line an entry, and the time it takes."""
    lines = [f"{'':<3}{'sensor':<18}{'indenter':<14}{'plan':<13}{'targets':>10}  state"]
    for number, progress in enumerate(found, 1):
        entry = progress.item.entry
        count = f"{progress.done}/{progress.item.total}"
        note = f" ({progress.note})" if progress.note else ""
        more = f", about {minutes(progress.left)} left" if progress.state != "done" else ""
        lines.append(
            f"{number:<3}{entry.sensor:<18}{entry.indenter:<14}{entry.plan:<13}{count:>10}  "
            f"{progress.state}{more}{note}"
        )
    done = sum(progress.state == "done" for progress in found)
    left = sum(progress.left for progress in found)
    lines.append(f"{done} of {len(found)} sessions done, about {minutes(left)} left")
    return lines
