"""State of a lab for the page: sessions, campaigns, benches with their set-up, indenters.

A session is named by its path in the catalogue, so no path sent by a client reaches the disk. Only
small columns of `frames` are read whole; images are read one by one.
"""

import functools
import io
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import numpy as np
from PIL import Image

from recorder.catalogue import Catalogue, Query, Row
from recorder.command_line.options import next_command
from recorder.errors import SessionError
from recorder.session import Session, resting, thumbnails
from recorder.spec import OUTCOMES, PHASES
from rig.acquire.calibration.store import FOLDER, SETUP, report_path
from rig.acquire.campaign import Campaign, load_campaign, marked, progress_of, write_marks
from rig.acquire.completed import finished_targets
from rig.acquire.preview import draw
from rig.bench.bench import BENCHES_FOLDER, Bench, BenchFile
from rig.bench.indenter import find_indenter, indenter_names
from rig.core.clock import SECOND_NS, Clock
from rig.core.config import from_si
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES, CAMPAIGNS, OTHERS
from trajectories import Plan, PressShear, plan_from_json

# Sessions of one answer to a search, frames of a session that is shown, points of its curves.
MOST_ROWS, MOST_FRAMES, MOST_POINTS = 300, 4_000_000, 700
# Letter of a target's outcome in messages.
LETTERS = {"open": ".", "done": "d", "limited": "l"}
# Sessions kept open, and the time after which the folder is looked at again [s].
_OPEN, _FRESH = 2, 1.0
_THUMBNAILS = 400
FORCE_LIMITED = OUTCOMES.index("force_limited")
Stamp = tuple[int, int, int]
_CHOICES = ("sensor", "indenter", "status")


class Finished:
    """The sessions below a folder."""

    def __init__(self, folder: Path, clock: Clock) -> None:
        self.folder = folder
        self._clock = clock
        self._catalogue = Catalogue(folder)
        self._looked_ns = 0
        # By path and stamp: a session that was recorded to again is read again.
        self._opened = functools.lru_cache(_OPEN)(self._open)
        self._thumbnails = functools.lru_cache(_THUMBNAILS)(self._thumbnail)

    def rows(self) -> list[Row]:
        """Return all sessions, the oldest first."""
        now_ns = self._clock.now_ns()
        if now_ns - self._looked_ns > _FRESH * SECOND_NS:
            self._catalogue.refresh()
            self._looked_ns = now_ns
        return list(self._catalogue)

    def search(self, conditions: Mapping[str, str]) -> dict[str, Any]:
        """Return the newest sessions by conditions, fields of `Query` as text, and the choices."""
        since = date.fromisoformat(conditions["since"]) if conditions.get("since") else None
        faults = {"": None, "yes": True, "no": False}
        if conditions.get("faults", "") not in faults:
            raise ValueError(f"faults: found {conditions['faults']!r}; allowed: yes, no")
        query = Query(
            sensor=conditions.get("sensor", ""),
            indenter=conditions.get("indenter", ""),
            status=conditions.get("status", ""),
            text=conditions.get("text", ""),
            since=since,
            faults=faults[conditions.get("faults", "")],
        )
        rows = self.rows()
        matches = [row for row in rows if query.accepts(row)]
        newest = matches[: -MOST_ROWS - 1 : -1]
        return {
            "rows": [{**asdict(row), "faults": row.faults} for row in newest],
            "found": len(matches),
            "total": len(rows),
            "choices": {
                key: sorted({getattr(row, key) for row in rows} - {""}) for key in _CHOICES
            },
        }

    def row(self, path: str) -> Row:
        """Return the row of a session."""
        for row in self.rows():
            if row.path == path:
                return row
        raise KeyError(f"no session {path[:200]!r}")

    def session(self, path: str) -> Session:
        """Return a session that is not being recorded."""
        row = self.row(path)
        if row.status == "recording":
            command = next_command("session", "recover", self.folder / path)
            raise SessionError(
                f"{path}: is being recorded, or was killed while it was; then recover it: {command}"
            )
        return self._opened(row.path, row.stamp)

    def _open(self, path: str, stamp: Stamp) -> Session:
        session = Session(self.folder / path)
        if (count := len(session.require_frames()["t_ns"])) > MOST_FRAMES:
            raise SessionError(f"{path}: found {count} frames; shown: up to {MOST_FRAMES}")
        return session

    def about(self, path: str) -> dict[str, Any]:
        """Return a session's constants, and its targets."""
        session, row = self.session(path), self.row(path)
        frames, targets = session.frames, session.plan_targets
        count, summary = len(frames["t_ns"]), session.attrs.get("summary") or {}
        plan = _plan(session)
        points = _points(session, plan)
        return {
            **asdict(row),
            "faults": row.faults,
            "frames": count,
            "rate": session.rate_hz,
            "cameras": session.of_kind("camera"),
            "taxels": "taxels" in frames,
            "streams": [
                {
                    "name": name,
                    "kind": session.streams[name].traits.kind,
                    "rows": len(session.streams[name]),
                    "rate": number(session.streams[name].rate_hz, 1),
                    "dropped": int((summary.get(name) or {}).get("dropped", 0)),
                }
                for name in session.order
            ],
            "points": [{"point": point, "at": at} for point, at in points.items()],
            "map": [
                [int(point), round(from_si(float(depth), "mm"), 4), int(direction)]
                for point, depth, direction in zip(
                    *(targets.get(key, ()) for key in ("point", "depth", "direction")), strict=True
                )
            ],
            "directions": plan.direction_count if isinstance(plan, PressShear) else 1,
            "outcomes": _outcomes(session, plan),
            "presses": _presses(session),
            "go_on": next_command("collect", resume=self.folder / path)
            if row.status == "stopped" and plan is not None
            else "",
        }

    def curves(self, path: str, first: int, last: int) -> dict[str, Any]:
        """Return the least and the largest values of force [N] and depth [mm] in parts of frames.

        These are the frames `first` to `last`, in at most MOST_POINTS equal parts, which begin at
        the frames `at` and the times `t`; the last frame is at the time `to` [s].
        """
        frames = self.session(path).frames
        count = len(frames["t_ns"])
        if not 0 <= first <= last < count:
            raise IndexError(f"no frames {first} to {last}; allowed: 0 to {count - 1}")
        parts = min(last + 1 - first, MOST_POINTS)
        edges = np.linspace(0, last + 1 - first, parts, endpoint=False).astype(int)
        seconds = (frames["t_ns"][first : last + 1] - frames["t_ns"][0]) / SECOND_NS
        curves: dict[str, Any] = {"at": (edges + first).tolist(), "to": number(seconds[-1])}
        curves["t"] = [number(t) for t in seconds[edges]]
        columns = {name: frames["wrench"][:, axis] for axis, name in enumerate(("fx", "fy", "fz"))}
        for name, values in (columns | {"depth": 1e3 * frames["depth"]}).items():
            ends = [each.reduceat(values[first : last + 1], edges) for each in (np.fmin, np.fmax)]
            curves[name] = [[number(a), number(b)] for a, b in zip(*ends, strict=True)]
        return curves

    def frame(self, path: str, k: int) -> dict[str, Any]:
        """Return the values of a frame."""
        session = self.session(path)
        frames = session.frames
        if not 0 <= k < len(frames["t_ns"]):
            raise IndexError(f"no frame {k}; allowed: 0 to {len(frames['t_ns']) - 1}")
        wrench = [float(value) for value in frames["wrench"][k]]
        phase, target = int(frames["phase"][k]), int(frames["target"][k])
        values: dict[str, Any] = {
            "frame": k,
            "t": round((int(frames["t_ns"][k]) - int(frames["t_ns"][0])) / SECOND_NS, 3),
            "run": int(frames["run"][k]),
            "target": target,
            "phase": PHASES[phase] if phase >= 0 else "",
            "depth": number(from_si(float(frames["depth"][k]), "mm")),
            "wrench": [number(each) for each in wrench[:3]]
            + [number(from_si(each, "n_mm")) for each in wrench[3:]],
            "valid": bool(frames["valid"][k]),
            "skew": number(1e3 * float(frames["skew"][k]), 1),
            "images": {
                name: int(frames[session.columns[name]][k]) for name in session.of_kind("camera")
            },
        }
        if "taxels" in frames:
            change = np.nan_to_num(frames["taxels"][k] - resting(session, "taxels"))
            values["taxels"] = np.round(change).astype(int).tolist()
        return values

    def image(self, path: str, k: int, camera: str) -> bytes:
        """Return the image of a frame as JPEG: the camera's own bytes, if they were kept."""
        session = self.session(path)
        if camera not in session.of_kind("camera"):
            raise KeyError(f"no camera {camera[:200]!r}")
        rows, stream = session.frames[session.columns[camera]], session.streams[camera]
        if not 0 <= k < len(rows) or rows[k] < 0:
            raise IndexError(f"frame {k} has no image of {camera}")
        original = stream.jpeg(int(rows[k]))
        if original is not None:
            return original
        pixels: Any = stream.images([int(rows[k])])[0]
        return _jpeg(Image.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels))

    def thumbnail(self, path: str) -> bytes:
        """Return a small picture of the frame with the largest force as JPEG."""
        row = self.row(path)
        return self._thumbnails(row.path, row.stamp)

    def _thumbnail(self, path: str, stamp: Stamp) -> bytes:
        session = self.session(path)
        load = np.nan_to_num(np.abs(session.frames["wrench"][:, 2]))
        if not load.size:
            raise IndexError(f"{path}: has no frames")
        frame = int(load.argmax()) if load.any() else len(load) // 2
        return _jpeg(thumbnails(session, np.array([frame]))[0])


def _jpeg(picture: Image.Image) -> bytes:
    jpeg = io.BytesIO()
    picture.save(jpeg, "JPEG", quality=85)
    return jpeg.getvalue()


def _plan(session: Session) -> Plan | None:
    try:
        return plan_from_json(session.attrs["plan"])
    except (KeyError, TypeError, ValueError, AttributeError):
        # A recording made elsewhere has presses that were found, without a plan.
        return None


def _points(session: Session, plan: Plan | None) -> dict[int, list[float]]:
    """Return x and y of each contact point in the contact frame [mm]; unknown ones in a row."""
    points = [int(point) for point in np.unique(session.targets.get("point", ()))]
    planned = {} if plan is None else {each.point: each.origin for each in plan.targets()}
    if set(points) <= set(planned):
        return {point: [from_si(v, "mm") for v in planned[point][:2]] for point in points}
    return {point: [float(k), 0.0] for k, point in enumerate(points)}


def _outcomes(session: Session, plan: Plan | None) -> str:
    """Return one of LETTERS for each target."""
    count, segments = len(session.plan_targets.get("point", ())), session.segments
    limited = set(segments["target"][segments["outcome"] == FORCE_LIMITED].tolist())
    pressed = {int(target) for target in np.unique(segments["target"])}
    done = pressed if plan is None else finished_targets(plan, segments, count)
    return "".join(
        LETTERS["limited" if k in limited else "done" if k in done else "open"]
        for k in range(count)
    )


def _presses(session: Session) -> dict[int, tuple[int, int]]:
    """Return the first and last frame of the last press of each target."""
    target, run = session.frames["target"], session.frames["run"]
    begins = np.flatnonzero(np.diff(target, prepend=-2) | np.diff(run, prepend=-1))
    ends = np.append(begins[1:], len(target)) - 1
    spans = zip(begins.tolist(), ends.tolist(), strict=False)
    return {int(target[first]): (first, last) for first, last in spans if target[first] >= 0}


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


class Values(dict[str, str]):
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
        self._routes: dict[str, Callable[[Values], Any]] = {
            "sessions": finished.search,
            "session": lambda query: self.session(query["session"]),
            "frame": lambda query: finished.frame(query["session"], query.whole("frame")),
            "curves": lambda query: finished.curves(
                query["session"], query.whole("first"), query.whole("last")
            ),
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
        content = self._routes[route](Values(query))
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
        return {
            **about,
            "again": list(marks),
            "queue": next_command("campaign", file=self._folders.again),
        }

    def mark(self, path: str, targets: tuple[int, ...]) -> dict[str, Any]:
        """Mark targets of a session, from 1 on, for recording again; none removes the marks."""
        session, row = self.finished.session(path), self.finished.row(path)
        if row.plan not in ("press_shear", "force_depth"):
            raise ConfigError(f"{path}: found plan {row.plan!r}; allowed: press_shear, force_depth")
        count = int(session.attrs["targets_wanted"])
        if targets and targets[-1] > count:
            raise ConfigError(f"again: found {targets[-1]}; allowed: 1 to {count}")
        write_marks(self._folders.again, self._folders.sessions / path, session, targets)
        return {"again": list(targets), "queue": next_command("campaign", file=self._folders.again)}

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
        return report_path(self._folders.calibrations, sensor).read_bytes()

    def _campaigns(self) -> list[dict[str, Any]]:
        files = sorted(self._folders.campaigns.glob("*.yaml"))[:_MOST]
        packaged = [] if files else list(CAMPAIGNS.glob("*.yaml"))
        return [self._campaign(path, packaged=not files) for path in files or packaged]

    def _campaign(self, path: Path, *, packaged: bool) -> dict[str, Any]:
        file = Path("campaigns") / path.name if packaged else path
        campaign: dict[str, Any] = {
            "name": path.stem,
            "command": next_command("campaign", file=file),
        }
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
            files |= {path.stem: path for path in each.glob("*.yaml") if path.stem not in OTHERS}
        return dict(sorted(files.items())[:_MOST])

    def _named(self, name: str) -> Bench:
        path = self._bench_files()[name]
        return self._bench(path, path.stat().st_mtime_ns)

    def _benches(self) -> list[dict[str, Any]]:
        rows = self.finished.rows()
        benches = []
        finished = [row for row in reversed(rows) if row.is_session and row.status != "recording"]
        for name in self._bench_files():
            try:
                bench = self._named(name)
            except (ConfigError, OSError) as error:
                benches.append({"name": name, "mock": False, "error": str(error)})
                continue
            own = (row for row in finished if (row.sensor, row.mock) == (bench.sensor, bench.mock))
            newest = next(own, None)
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
                    "report": accepted is not None
                    and report_path(self._folders.calibrations, sensor).is_file(),
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


def number(value: Any, digits: int = 3) -> float | None:
    """Return a rounded float for JSON; None if it is not finite."""
    number = float(value)
    return round(number, digits) if math.isfinite(number) else None
