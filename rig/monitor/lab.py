"""State of a lab for the page: sessions, campaigns, benches with their set-up, indenters."""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

from recorder import SessionError
from recorder.catalogue import Row
from recorder.command_line.options import next_command
from rig.acquire.calibration.store import FOLDER, SETUP, report_path
from rig.acquire.campaign import Campaign, load_campaign, marked, progress_of, write_marks
from rig.acquire.preview import draw
from rig.bench.bench import BENCHES_FOLDER, Bench, BenchFile
from rig.bench.indenter import find_indenter, indenter_names
from rig.core.clock import Clock
from rig.core.config import from_si
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES, CAMPAIGNS
from rig.monitor.finished import Finished

# File beside a session with the port of its page, as long as the page is served.
ADDRESS = ".tactile-page.json"
# Most campaign files and benches that are shown.
_MOST = 40
# Types of pictures, by their first bytes; any other content is a report.
_TYPES = {b"\xff\xd8": "image/jpeg", b"\x89PNG": "image/png"}


@dataclass(frozen=True, slots=True)
class Folders:
    """Folders of a lab."""

    sessions: Path
    benches: Path = BENCHES_FOLDER
    calibrations: Path = FOLDER
    campaigns: Path = Path("campaigns")

    @property
    def again(self) -> Path:
        """Campaign file of the targets to record again."""
        return self.campaigns / "again.yaml"


class Query(dict[str, str]):
    """Values of a request: the part of its address after `?`, whose length the server limits."""

    def __init__(self, text: str) -> None:
        super().__init__(parse_qsl(text, keep_blank_values=True))

    def __missing__(self, key: str) -> str:
        """Refuse a request that lacks a value."""
        raise ValueError(f"{key}: missing")

    def whole(self, key: str) -> int:
        """Return a whole number."""
        text = self[key]
        if not (text.isascii() and text.isdigit() and len(text) < 10):
            raise ValueError(f"{key}: found {text!r}; allowed: a whole number")
        return int(text)


class Lab:
    """The lab. Its methods are called by one thread."""

    def __init__(self, folders: Folders, clock: Clock) -> None:
        self._folders = folders
        self.finished = finished = Finished(folders.sessions, clock)
        # Read again when the file has changed; changes of other files that it names are missed.
        self._bench = functools.lru_cache(maxsize=_MOST)(_load)
        self._loaded = functools.lru_cache(maxsize=_MOST)(_load_campaign)
        self._routes: dict[str, Callable[[Query], Any]] = {
            "sessions": finished.search,
            "session": lambda query: self.session(query["session"]),
            "frame": lambda query: finished.frame(query["session"], query.whole("frame")),
            "image": lambda query: finished.image(
                query["session"], query.whole("frame"), query["camera"]
            ),
            "thumbnail": lambda query: finished.thumbnail(query["session"]),
            "lab": lambda query: self.state(),
            "plan": lambda query: self.plan_picture(query["sensor"]),
            "indenter": lambda query: self.indenter_picture(query["name"]),
            "report": lambda query: self.report(query["sensor"]),
        }

    def answer(self, route: str, query: str) -> tuple[bytes, str]:
        """Return the content of a route for a request's values, and its type."""
        content = self._routes[route](Query(query))
        if not isinstance(content, bytes):
            return json.dumps(content).encode(), "application/json"
        start = next((start for start in _TYPES if content.startswith(start)), b"")
        return content, _TYPES.get(start, "text/html; charset=utf-8")

    def state(self) -> dict[str, Any]:
        """Return campaigns, benches, set-ups, indenters and a running collection's page."""
        return {
            "campaigns": self._campaigns(),
            "benches": self._benches(),
            "setups": self._setups(),
            "indenters": _indenters(tuple(indenter_names())),
            "running": self._running(),
        }

    def session(self, path: str) -> dict[str, Any]:
        """Return what is constant about a session, with the targets marked in it."""
        about = self.finished.about(path)
        marks = marked(self._folders.again, self._folders.sessions / path)
        return {**about, "again": list(marks), "queue": self._command(self._folders.again)}

    def mark(self, path: str, targets: tuple[int, ...]) -> dict[str, Any]:
        """Mark targets of a session, from 1 on, for recording again; none removes the marks."""
        session, row = self.finished.session(path), self.finished.row(path)
        if row.plan not in ("press_shear", "force_depth"):
            raise ConfigError(f"{path}: found plan {row.plan!r}; allowed: press_shear, force_depth")
        count = int(session.attrs["targets_wanted"])
        if targets and targets[-1] > count:
            raise ConfigError(f"again: found {targets[-1]}; allowed: 1 to {count}")
        write_marks(self._folders.again, self._folders.sessions / path, session, targets)
        return {"again": list(targets), "queue": self._command(self._folders.again)}

    def plan_picture(self, sensor: str) -> bytes:
        """Return the drawing of a bench's plan as PNG."""
        bench, png = self._named(sensor), io.BytesIO()
        draw(bench, bench.dry_run(bench.trajectory)).save(png, "PNG")
        return png.getvalue()

    def indenter_picture(self, name: str) -> bytes:
        """Return the drawing of an indenter as PNG."""
        drawing = find_indenter(name).drawing if name in indenter_names() else None
        if drawing is None:
            raise KeyError(f"no drawing of {name!r}")
        return drawing.read_bytes()

    def report(self, sensor: str) -> bytes:
        """Return the acceptance report of a bench as HTML."""
        if sensor not in [setup["sensor"] for setup in self._setups()]:
            raise KeyError(f"no report of {sensor!r}")
        return self._report(sensor).read_bytes()

    def _report(self, sensor: str) -> Path:
        return report_path(self._folders.calibrations, sensor)

    def _command(self, file: Path) -> str:
        return next_command("campaign", file=file)

    def _campaigns(self) -> list[dict[str, Any]]:
        files = sorted(self._folders.campaigns.glob("*.yaml"))[:_MOST]
        packaged = [] if files else list(CAMPAIGNS.glob("*.yaml"))
        return [self._campaign(path, packaged=not files) for path in files or packaged]

    def _campaign(self, path: Path, *, packaged: bool) -> dict[str, Any]:
        file = Path("campaigns") / path.name if packaged else path
        campaign: dict[str, Any] = {"name": path.stem, "command": self._command(file)}
        try:
            loaded = self._loaded(path, path.stat().st_mtime_ns, self._folders.benches)
            progress = progress_of(loaded)
        except (ConfigError, SessionError, OSError) as error:
            return {**campaign, "error": str(error), "items": []}
        items = [
            {
                "sensor": each.item.entry.sensor,
                "indenter": each.item.entry.indenter,
                "plan": each.item.entry.plan,
                "again": list(each.item.entry.again),
                "session": self._inside(each.session),
                "state": each.state,
                "done": each.done,
                "total": each.item.total,
                "left": round(each.left),
                "note": each.note,
            }
            for each in progress
        ]
        return {**campaign, "error": "", "items": items}

    def _inside(self, session: Path) -> str:
        """Return the path of a session in the folder that is shown; empty if it is elsewhere."""
        try:
            path = session.resolve().relative_to(self._folders.sessions.resolve())
        except ValueError:
            return ""
        return str(path) if session.exists() else ""

    def _bench_files(self) -> dict[str, Path]:
        folder = self._folders.benches
        files: dict[str, Path] = {}
        for each in (BENCHES, folder, folder / "lab"):
            files |= {path.stem: path for path in each.glob("*.yaml") if path.stem != "mock"}
        return dict(sorted(files.items())[:_MOST])

    def _named(self, name: str) -> Bench:
        path = self._bench_files()[name]
        return self._bench(path, path.stat().st_mtime_ns)

    def _benches(self) -> list[dict[str, Any]]:
        rows = self.finished.rows()
        benches = []
        for name in self._bench_files():
            try:
                bench = self._named(name)
            except (ConfigError, OSError) as error:
                benches.append({"name": name, "mock": False, "error": str(error)})
                continue
            newest = next((row for row in reversed(rows) if _is_of(row, bench)), None)
            benches.append(
                {
                    "name": name,
                    "error": "",
                    "sensor": bench.sensor,
                    "description": bench.description,
                    "mock": bench.mock,
                    "targets": len(bench.trajectory),
                    "streams": [row.name for row in bench.rows],
                    "newest": newest.path if newest else "",
                }
            )
        return benches

    def _setups(self) -> list[dict[str, Any]]:
        setups: list[dict[str, Any]] = []
        for path in sorted(self._folders.calibrations.glob(f"*{SETUP}"))[:_MOST]:
            sensor = path.name.removesuffix(SETUP)
            try:
                stored = json.loads(path.read_text())
                steps = [{"name": name, **step} for name, step in stored["steps"].items()]
                accepted, running = stored.get("acceptance"), stored.get("running")
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                setups.append({"sensor": sensor, "error": f"{path}: {error}", "steps": []})
                continue
            if running and not _lives(running):
                running = None
            setups.append(
                {
                    "sensor": sensor,
                    "mock": bool(stored.get("mock")),
                    "error": "",
                    "steps": steps,
                    "running": running,
                    "result": (accepted or {}).get("result", ""),
                    "report": accepted is not None and self._report(sensor).is_file(),
                }
            )
        return setups

    def _running(self) -> dict[str, Any] | None:
        """Return port and session of a running collection's page; None if there is none."""
        for folder in {Path(row.path).parent for row in self.finished.rows()} | {Path()}:
            try:
                page = json.loads((self.finished.folder / folder / ADDRESS).read_text())
                if _lives(page):
                    return {"port": int(page["port"]), "session": str(page["session"])}
            except (OSError, ValueError, KeyError, TypeError):
                continue
        return None


def _lives(stored: dict[str, Any]) -> bool:
    """Return True if the process that stored this under `pid` has not ended."""
    return Path(f"/proc/{int(stored['pid'])}").exists()


def _is_of(row: Row, bench: Bench) -> bool:
    """Return True for a finished session of a bench."""
    finished = row.is_session and row.status != "recording"
    return finished and row.sensor == bench.sensor and row.mock == bench.mock


def _load(path: Path, stamp: int) -> Bench:
    return BenchFile.read(path).bench


def _load_campaign(path: Path, stamp: int, benches: Path) -> Campaign:
    return load_campaign(path, benches)


@functools.cache
def _indenters(names: tuple[str, ...]) -> list[dict[str, Any]]:
    indenters = []
    for name in names:
        try:
            indenter = find_indenter(name)
        except (ConfigError, OSError) as error:
            indenters.append({"name": name, "tip": str(error), "size": "", "drawing": False})
            continue
        size = " x ".join(f"{from_si(width, 'mm'):g}" for width in indenter.size)
        drawing = indenter.drawing is not None
        indenters.append(
            {"name": name, "tip": indenter.tip, "size": f"{size} mm", "drawing": drawing}
        )
    return indenters
