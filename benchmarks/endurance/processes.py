"""What the processes of a collection hold of the machine, read from /proc."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path

PROC = Path("/proc")


@dataclass(slots=True)
class Track:
    """One process over time."""

    role: str
    """What it is there for."""
    seconds: list[float] = field(default_factory=list)
    """When it was looked at, since the start [s]."""
    memory: list[float] = field(default_factory=list)
    """Memory of its own then: anonymous pages, no files it has mapped [bytes]."""
    files: list[int] = field(default_factory=list)
    """Open file descriptors then."""
    cpu: float = 0.0
    """User and system time so far [s]."""


def role_of(pid: int, command: str, session: Path) -> str:
    """What a process below the collecting one is there for.

    Args:
        pid: The process.
        command: Its command line.
        session: What the collection writes.
    """
    emulator = re.search(r"-m rig\.(?:devices|mock)\.(\w+)\.(\w+)", command)
    if emulator:
        of_world = {"host": "World", "solver": "World's solver"}
        return of_world.get(emulator[2], f"{emulator[1]} emulator")
    if "resource_tracker" in command:
        return "resource tracker"
    written = _stream_written(pid, session)
    return f"{written} stream" if written else "arm"


def look(pid: int, track: Track, seconds: float) -> None:
    """Add what process `pid` holds at `seconds` to `track`; one that has gone adds nothing."""
    status = _text(PROC / str(pid) / "status")
    anonymous = re.search(r"RssAnon:\s+(\d+) kB", status)
    stat = _text(PROC / str(pid) / "stat")
    if anonymous is None or not stat:
        return
    fields = stat.rsplit(")", 1)[1].split()
    try:
        files = len(os.listdir(PROC / str(pid) / "fd"))
    except OSError:
        return
    track.cpu = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    track.seconds.append(seconds)
    track.memory.append(1024.0 * int(anonymous[1]))
    track.files.append(files)


def _stream_written(pid: int, session: Path) -> str | None:
    folder = str(session.resolve() / "streams") + "/"
    try:
        links = [os.readlink(link) for link in (PROC / str(pid) / "fd").iterdir()]
    except OSError:
        return None
    for link in links:
        if link.startswith(folder):
            return link.removeprefix(folder).split("/")[0]
    return None


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
