"""Finished sessions of a folder: search, and one frame at a time.

A session is named by its path in the catalogue, so no path sent by a client reaches the disk. Only
small columns of `frames` are read whole; images are read one by one.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Mapping
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from recorder import OUTCOMES, PHASES, Session, SessionError
from recorder.catalogue import Catalogue, Query, Row
from recorder.session import thumbnails
from rig.acquire.request import finished_targets
from rig.core.clock import SECOND_NS, Clock
from rig.core.config import from_si
from rig.monitor.live_view import number
from trajectories import Plan, PressShear, plan_from_json

# Sessions of one answer to a search, frames of a session that is shown, points of its curves.
MOST_ROWS, MOST_FRAMES, MOST_POINTS = 300, 4_000_000, 700
# Letter of a target's outcome in messages.
LETTERS = {"open": ".", "done": "d", "limited": "l"}
# Sessions kept open, and the time after which the folder is looked at again [s].
_OPEN, _FRESH = 2, 1.0
_THUMBNAILS = 400
_FORCE_LIMITED = OUTCOMES.index("force_limited")
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
        """Return the newest sessions that meet the conditions, and the choices for each of them.

        These are fields of `Query` as text; an empty one is no condition.
        """
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
            raise SessionError(f"{path}: is being recorded, or was killed while it was")
        return self._opened(row.path, row.stamp)

    def _open(self, path: str, stamp: Stamp) -> Session:
        session = Session(self.folder / path)
        if (count := len(session.require_frames()["t_ns"])) > MOST_FRAMES:
            raise SessionError(f"{path}: found {count} frames; shown: up to {MOST_FRAMES}")
        return session

    def about(self, path: str) -> dict[str, Any]:
        """Return what is constant about a session, its targets and its curves."""
        session, row = self.session(path), self.row(path)
        frames, targets = session.frames, session.targets
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
            "starts": _starts(session),
            "curves": _curves(session),
        }

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
            rest = session.reference["taxels"]
            finite = np.flatnonzero(np.isfinite(rest).all(axis=(1, 2)))
            zero = rest[finite[0]] if finite.size else frames["taxels"][0]
            change = np.nan_to_num(frames["taxels"][k] - zero)
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
    count, segments = len(session.targets.get("point", ())), session.segments
    limited = set(segments["target"][segments["outcome"] == _FORCE_LIMITED].tolist())
    pressed = {int(target) for target in np.unique(segments["target"])}
    done = pressed if plan is None else finished_targets(plan, segments, count)
    return "".join(
        LETTERS["limited" if k in limited else "done" if k in done else "open"]
        for k in range(count)
    )


def _starts(session: Session) -> dict[int, int]:
    """Return the first frame of the last press of each target."""
    target, run = session.frames["target"], session.frames["run"]
    another = (np.diff(target) != 0) | (np.diff(run) != 0)
    begins = np.concatenate([[0], np.flatnonzero(another) + 1])[: len(target)]
    return {int(target[k]): int(k) for k in begins if target[k] >= 0}


def _curves(session: Session) -> dict[str, Any]:
    """Return the least and the largest value of each curve in equal parts of the frames."""
    frames = session.frames
    count = len(frames["t_ns"])
    edges = np.unique(np.linspace(0, count, min(count, MOST_POINTS) + 1).astype(int))[:-1]
    curves: dict[str, Any] = {"at": edges.tolist()}
    columns = {name: frames["wrench"][:, axis] for axis, name in enumerate(("fx", "fy", "fz"))}
    columns["depth"] = frames["depth"] * 1e3
    for name, values in columns.items():
        ends = [each.reduceat(values, edges) for each in (np.fmin, np.fmax) if count]
        curves[name] = [[number(a), number(b)] for a, b in zip(*ends, strict=True)]
    return curves
