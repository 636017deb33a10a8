"""A campaign file: what to record today, in which order."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rig.bench import Bench, find_bench, load_bench
from rig.config import build, read_yaml
from rig.errors import ConfigError
from trajectories import Plan, rehearse

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


@dataclass(frozen=True, slots=True)
class Entry:
    """One session to record."""

    sensor: str
    """Name of a bench file."""
    indenter: str
    """What the technician mounts."""
    plan: Literal["press_shear", "force_depth"] = "press_shear"
    """The bench's trajectory, or its force_depth."""
    targets: int | None = None
    """Only the first so many targets; None for all."""

    def __post_init__(self) -> None:
        """Refuse names that are no file names, and a number of targets that makes no sense."""
        for key in ("sensor", "indenter"):
            value = getattr(self, key)
            if not _NAME.fullmatch(value):
                raise ValueError(f"{key}: {value!r}; allowed: letters, digits, - and _")
        if self.targets is not None and (self.targets < 1 or self.plan != "press_shear"):
            raise ValueError(f"targets: {self.targets!r}; allowed: 1 or more, for press_shear")

    @property
    def name(self) -> str:
        """Of its session, unique in a campaign."""
        targets = "" if self.targets is None else f"-{self.targets}"
        return f"{self.sensor}-{self.indenter}-{self.plan.replace('_', '-')}{targets}"


@dataclass(frozen=True, slots=True)
class Item:
    """An entry with the bench that records it."""

    entry: Entry
    bench_path: Path
    bench: Bench
    plan: Plan
    total: int
    """Targets wanted."""
    duration: float
    """Moving time the plan foretells [s]; preflight and pauses come on top."""


@dataclass(frozen=True, slots=True)
class Campaign:
    """A campaign file, checked against its benches."""

    name: str
    items: tuple[Item, ...]
    operator: str
    out: Path
    """Folder of its sessions: they are also its memory of what is done."""


def load_campaign(path: Path, benches: Path) -> Campaign:
    """Read a campaign file and every bench it names.

    Args:
        path: YAML with `out`, `operator` (both optional) and `sessions`, a list of entries.
        benches: Folder of bench files.

    Raises:
        ConfigError: Something in it, or in a bench it names, cannot be used.
    """
    content = read_yaml(path)
    if unknown := sorted(set(content) - {"out", "operator", "sessions"}):
        raise ConfigError(f"{path}: unknown {unknown}; known: ['operator', 'out', 'sessions']")
    listed = content.get("sessions")
    if not isinstance(listed, list) or not listed:
        raise ConfigError(f"{path}.sessions: found {listed!r}; allowed: a list of sessions")
    entries = [build(Entry, item, f"{path}.sessions[{k}]") for k, item in enumerate(listed)]
    names = [entry.name for entry in entries]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ConfigError(f"{path}.sessions: {', '.join(twice)}: listed twice; allowed: once")
    items = tuple(_item(entry, f"{path}.sessions[{k}]", benches) for k, entry in enumerate(entries))
    out = content.get("out", f"sessions/{path.stem}")
    operator = content.get("operator", "")
    for key, value in (("out", out), ("operator", operator)):
        if not isinstance(value, str):
            raise ConfigError(f"{path}.{key}: found {value!r}; allowed: text")
    return Campaign(path.stem, items, operator, Path(out))


def _item(entry: Entry, where: str, benches: Path) -> Item:
    try:
        bench_path = find_bench(entry.sensor, benches)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None
    bench, _ = load_bench(bench_path)
    plan: Plan | None = bench.trajectory if entry.plan == "press_shear" else bench.force_depth
    if plan is None or plan.kind != entry.plan:
        raise ConfigError(f"{where}.plan: found {entry.plan!r}; {bench_path} has none")
    total = len(plan) if entry.targets is None else entry.targets
    if total > len(plan):
        raise ConfigError(f"{where}.targets: found {total}; allowed: 1 to {len(plan)}")
    walked = rehearse(
        plan, bench.limits.plan, speed=bench.arm.speed, acceleration=bench.arm.acceleration
    )
    if walked.broken:
        raise ConfigError(f"{where}: the plan breaks a limit: {'; '.join(walked.broken)}")
    return Item(entry, bench_path, bench, plan, total, walked.duration * total / len(plan))
