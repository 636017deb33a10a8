"""Campaigns: files that list the sessions to record, and their progress."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from recorder.catalogue import Catalogue, Row
from recorder.command_line import terminal
from recorder.command_line.terminal import State
from recorder.errors import SessionError
from recorder.progress import duration
from recorder.session import Session
from recorder.store import replace_file
from rig.acquire.completed import finished_targets, first_open_target, left_out_of
from rig.bench.bench import Bench, BenchFile, find_bench
from rig.bench.indenter import find_indenter
from rig.core.config import build, read_yaml
from rig.core.errors import ConfigError
from rig.core.packaged import CAMPAIGNS, packaged
from trajectories import Plan, plan_from_json

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


@dataclass(frozen=True, slots=True)
class Entry:
    """One session to record."""

    sensor: str
    """Name of a bench file."""
    indenter: str
    """Indenter for the technician to mount."""
    plan: Literal["press_shear", "force_depth"] = "press_shear"
    """The bench's trajectory, or its force_depth."""
    targets: int | None = None
    """Press only this many targets; None for all."""
    session: str = ""
    """Recorded session of which targets are pressed again; empty: a new session."""
    again: tuple[int, ...] = ()
    """Its targets to press again, numbered from 1; the new presses become another run."""
    runs: int = 0
    """Number of runs that it had when they were chosen: what later runs finished is done."""

    def __post_init__(self) -> None:
        for key in ("sensor", "indenter"):
            value = getattr(self, key)
            if not _NAME.fullmatch(value):
                raise ValueError(f"{key}: {value!r}; allowed: letters, digits, - and _")
        if self.targets is not None and (self.targets < 1 or self.plan != "press_shear"):
            raise ValueError(f"targets: {self.targets!r}; allowed: 1 or more, for press_shear")
        if bool(self.session) != bool(self.again) or any(target < 1 for target in self.again):
            raise ValueError(f"again: {self.again!r}; allowed: numbers from 1, with `session`")

    @property
    def name(self) -> str:
        """Name of its session; an entry that is listed again gets a number after it."""
        if self.session:
            return Path(self.session).stem
        targets = "" if self.targets is None else f"-{self.targets}"
        return f"{self.sensor}-{self.indenter}-{self.plan.replace('_', '-')}{targets}"


@dataclass(frozen=True, slots=True)
class CampaignFile:
    """Content of a campaign file."""

    sessions: tuple[Entry, ...]
    """At least one."""
    out: str = ""
    """Folder of the sessions; empty: `sessions/` and the name of the file."""
    operator: str = ""

    def __post_init__(self) -> None:
        if not self.sessions:
            raise ValueError("sessions: found none; allowed: a list of sessions")


@dataclass(frozen=True, slots=True)
class Item:
    """An entry with the bench that records it."""

    entry: Entry
    bench_path: Path
    bench: Bench
    plan: Plan
    total: int
    """Number of targets to press."""
    duration: float
    """Predicted moving time [s], without preflight and pauses."""
    name: str
    """Name of its session, unique in the campaign."""


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign file, checked against its benches."""

    name: str
    items: tuple[Item, ...]
    operator: str
    out: Path
    """Folder of its sessions, from which progress is read."""


def load_campaign(path: Path, benches: Path) -> Campaign:
    """Read a campaign file, or the packaged one of that name, and every bench in it.

    Benches are searched in the folder `benches`, then among the packaged ones.
    """
    file = build(CampaignFile, read_yaml(packaged(path, CAMPAIGNS)), str(path))
    times: Counter[str] = Counter()
    walked: dict[tuple[str, str], _Walked] = {}
    items = []
    for number, entry in enumerate(file.sessions):
        key_path, key = f"{path}.sessions[{number}]", (entry.sensor, entry.plan)
        if key not in walked:
            walked[key] = _walk(entry, key_path, benches)
        find_indenter(entry.indenter, f"{key_path}.indenter")
        bench_path, bench, plan, seconds = walked[key]
        name = entry.name
        if not entry.session:
            times[name] += 1
            name += f"-again-{times[name]}" if times[name] > 1 else ""
        else:
            try:
                plan = plan_from_json(Session(entry.session).attrs["plan"])
            except (SessionError, KeyError, TypeError, ValueError) as error:
                raise ConfigError(f"{key_path}.session: {error}") from None
        last = max(entry.again, default=len(plan) if entry.targets is None else entry.targets)
        if last > len(plan):
            listed = "again" if entry.session else "targets"
            raise ConfigError(f"{key_path}.{listed}: found {last}; allowed: 1 to {len(plan)}")
        total = len(entry.again) or last
        seconds = seconds * total / len(plan)
        items.append(Item(entry, bench_path, bench, plan, total, seconds, name))
    out = Path(file.out or f"sessions/{path.stem}")
    return Campaign(path.stem, tuple(items), file.operator, out)


# A bench file, its bench, one of its plans, and the duration of that plan [s].
_Walked = tuple[Path, Bench, Plan, float]


def _walk(entry: Entry, where: str, benches: Path) -> _Walked:
    bench_path = find_bench(entry.sensor, benches, f"{where}.sensor")
    bench = BenchFile.read(bench_path).bench
    plan: Plan | None = bench.trajectory if entry.plan == "press_shear" else bench.force_depth
    if plan is None or entry.plan != plan.KIND:
        raise ConfigError(f"{where}.plan: found {entry.plan!r}; {bench_path} has none")
    walked = bench.dry_run(plan)
    if walked.broken:
        raise ConfigError(f"{where}: the plan breaks a limit: {'; '.join(walked.broken)}")
    return bench_path, bench, plan, sum(bench.seconds(plan))


# Progress of a campaign, read from its sessions only.

# Time for preflight, tare, sealing and a smooth swap of the indenter [s].
_OVERHEAD = 20.0

ItemState = Literal["done", "to resume", "open", "unreadable"]
_COLOURS: dict[ItemState, State] = {
    "done": "good",
    "to resume": "note",
    "open": "",
    "unreadable": "fault",
}


@dataclass(frozen=True, slots=True)
class Progress:
    """State of one session of a campaign on disk."""

    item: Item
    session: Path
    state: ItemState
    done: int
    """Number of finished targets."""
    note: str = ""
    """Reason why it was stopped or cannot be read."""
    again: tuple[int, ...] = ()
    """Targets that are still to be pressed again, numbered from 1."""

    @property
    def left(self) -> float:
        """Estimated remaining time [s]."""
        if self.state == "done":
            return 0.0
        return _OVERHEAD + self.item.duration * (1 - self.done / self.item.total)


def progress_of(campaign: Campaign) -> list[Progress]:
    """Return the state of every entry's session, in order."""
    catalogue = None
    if campaign.out.is_dir():
        catalogue = Catalogue(campaign.out)
        catalogue.refresh()
    return [progress_in(campaign, item, catalogue) for item in campaign.items]


def progress_in(campaign: Campaign, item: Item, catalogue: Catalogue | None) -> Progress:
    """Return the state of one entry's session; it is opened only if it is not complete."""
    entry, path = item.entry, campaign.out / f"{item.name}.zarr"
    try:
        if entry.session:
            path = Path(entry.session)
            left = _targets_left(entry)
            state: ItemState = "to resume" if left else "done"
            return Progress(item, path, state, item.total - len(left), again=left)
        row = None if catalogue is None else catalogue.look(path.name)
        if catalogue is None or (row is None and not path.exists()):
            return Progress(item, path, "open", 0)
        if note := _mismatch(item, row):
            return Progress(item, path, "unreadable", 0, note)
        if row is not None and row.is_session and row.status == "complete":
            return Progress(item, path, "done", row.targets)
        session = Session(path)
        plan = plan_from_json(session.attrs["plan"])
        total, out = int(session.attrs["targets_wanted"]), left_out_of(session.attrs)
        done = first_open_target(plan, session.segments, total, out)
        return Progress(item, path, "to resume", done, str(session.attrs.get("reason", "")))
    except (SessionError, OSError, ValueError, KeyError) as error:
        return Progress(item, path, "unreadable", 0, str(error))


def _targets_left(entry: Entry) -> tuple[int, ...]:
    """Return the targets to press again that no run since has finished, numbered from 1."""
    session = Session(entry.session)
    plan = plan_from_json(session.attrs["plan"])
    later = session.segments["run"] >= entry.runs
    segments = {key: session.segments[key][later] for key in ("target", "phase", "outcome", "run")}
    done = finished_targets(plan, segments, int(session.attrs["targets_wanted"]))
    return tuple(target for target in entry.again if target - 1 not in done)


def _mismatch(item: Item, row: Row | None) -> str:
    """Return why a session cannot be that of an entry; empty if it can."""
    wanted = {"sensor": item.bench.sensor, "indenter": item.entry.indenter}
    for key, value in wanted.items():
        if row is not None and row.is_session and getattr(row, key) != value:
            return f"its {key} is {getattr(row, key)!r}: move it away"
    return ""


def table(states: list[Progress]) -> list[str]:
    """Return a table of finished and open entries with the remaining time, as lines."""
    entries = [progress.item.entry for progress in states]
    columns = {
        "": range(1, len(states) + 1),
        "sensor": [entry.sensor for entry in entries],
        "indenter": [entry.indenter for entry in entries],
        "plan": [entry.plan for entry in entries],
        "targets": [f"{progress.done}/{progress.item.total}" for progress in states],
        "state": [progress.state for progress in states],
        "left": [duration(each.left) if each.state != "done" else "" for each in states],
        "note": [progress.note for progress in states],
    }
    colours: list[State] = [_COLOURS[progress.state] for progress in states]
    done = sum(progress.state == "done" for progress in states)
    left = duration(sum(progress.left for progress in states))
    total = f"{done} of {len(states)} sessions done, about {left} left"
    return [*terminal.table(columns, spare=["plan"], states=colours), total]


# Targets of finished sessions that are to be recorded again, as a campaign file of such entries.


_HEAD = "# Targets to record again, marked on the page (tactile page).\n"


def marked(file: Path, session: Path) -> tuple[int, ...]:
    """Return the targets of a session that the file lists, numbered from 1."""
    return next((e.again for e in _entries(file) if Path(e.session) == session), ())


def write_marks(file: Path, path: Path, session: Session, targets: Sequence[int]) -> None:
    """List targets of a session in the file, in place of those that it listed before.

    They are numbered from 1; without any, the session is no longer listed. `path` is that of the
    session, relative to the folder where commands run.
    """
    kept = [entry for entry in _entries(file) if Path(entry.session) != path]
    if targets:
        indenter = find_indenter(str(session.attrs.get("indenter"))).name
        plan = session.attrs["plan"]["kind"]
        entry = Entry(str(session.attrs["sensor"]), indenter, plan)
        again = tuple(sorted(targets))
        kept.append(replace(entry, session=str(path), again=again, runs=len(session.runs)))
    rows = [
        f"  - {{sensor: {entry.sensor}, indenter: {entry.indenter}, plan: {entry.plan}, "
        f"session: {json.dumps(entry.session)}, again: {list(entry.again)}, runs: {entry.runs}}}\n"
        for entry in kept
    ]
    try:
        if rows:
            file.parent.mkdir(parents=True, exist_ok=True)
            replace_file(file, "".join([_HEAD, "sessions:\n", *rows]).encode())
        else:
            file.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written ({error})") from error


def _entries(file: Path) -> tuple[Entry, ...]:
    if not file.exists():
        return ()
    entries = build(CampaignFile, read_yaml(file), str(file)).sessions
    if strange := [entry.name for entry in entries if not entry.again]:
        raise ConfigError(f"{file}: found {strange[0]} without `again`; move the file away")
    return entries
