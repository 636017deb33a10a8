"""Memory, files and CPU time of a collection's processes, read from /proc."""

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
    """Role of the process."""
    seconds: list[float] = field(default_factory=list)
    """Times of observation since the start [s]."""
    memory: list[float] = field(default_factory=list)
    """Anonymous memory at those times, without mapped files [bytes]."""
    files: list[int] = field(default_factory=list)
    """Numbers of open file descriptors at those times."""
    cpu: float = 0.0
    """User and system time so far [s]."""


def role_of(pid: int, command: str, session: Path) -> str:
    """Return the role of a child process of the collection.

    Args:
        pid: Process id.
        command: Its command line.
        session: Session that the collection writes.
    """
    emulator = re.search(r"-m rig\.mock\.emulate .*/(\w+)\.json", command)
    if emulator:
        of_world = {"world": "World", "solver": "World's solver"}
        return of_world.get(emulator[1], f"{emulator[1]} emulator")
    if "resource_tracker" in command:
        return "resource tracker"
    written = _stream_written(pid, session)
    return f"{written} stream" if written else "arm"


def look(pid: int, track: Track, seconds: float) -> None:
    """Add the resource use of process `pid` at `seconds` to `track`, if it still runs."""
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
