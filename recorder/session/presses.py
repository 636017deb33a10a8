"""Presses of a session as its witnesses see them: force and place in each phase."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.session import align
from recorder.session.columns import Stream, blocks
from recorder.session.contact_frame import in_frame, surface_heights
from recorder.session.reader import Session
from recorder.spec import AXES, PHASES

Floats = NDArray[np.float64]
Times = NDArray[np.int64]

DOWN, ASIDE, BACK, UP = range(len(PHASES))
# Rows at the beginning of a gauge's stream that tell its noise.
NOISE_ROWS = 20_000
# A force that is felt is larger than this multiple of a sample's noise and this force [N] together.
NOISE, FELT = 5.0, 0.1
# Part of the depth from which a press pulls in no skin.
PRESSED = 0.3
# Least depth of a press that is more than a touch [m].
DEEP = 0.25e-3


@dataclass(frozen=True, slots=True, eq=False)
class Phase:
    """Samples of the gauge in one phase of a press."""

    target: int
    """Index of the target, numbered from 0."""
    code: int
    """Code of the phase, of `PHASES`."""
    whole: bool
    """True if it went on to its end."""
    run: int
    """Run of the session."""
    start: int
    """When it began [ns]."""
    end: int
    """When it ended [ns]."""
    first: int
    """Row of the force stream that its first sample is in."""
    count: int
    """Number n of its samples."""
    offset: Floats
    """Forces and torques of the point's reference (6,) [N, N m]."""
    presses: Presses

    @property
    def stored(self) -> Floats:
        """Forces and torques (n, 6) [N, N m] as they are stored."""
        return self.presses.values(self.first, self.first + self.count)

    @property
    def depth(self) -> Floats:
        """Indentation (n,) [m]; NaN without an arm or a contact frame."""
        return np.asarray(self.presses.height(self.target) - self.tip[:, 2])

    @property
    def tip(self) -> Floats:
        """Places of the tip (n, 3) [m] in the contact frame; NaN without an arm or that frame."""
        if self.presses.force is None:
            return np.zeros((0, 3))
        times = self.presses.force.rows("t_ns", slice(self.first, self.first + self.count))[:]
        return self.presses.place(self.run, times)

    @property
    def place(self) -> Floats:
        """Places of the tip (m, 3) [m] in the contact frame, at the arm's rate; may be empty."""
        moments, places = self.presses.places(self.run)
        return places[slice(*np.searchsorted(moments, (self.start, self.end)))]

    @property
    def way(self) -> complex:
        """Way of the tip aside [m]: along x, and along y as the imaginary part; 0 if unknown."""
        place = self.place
        return complex(*(place[-1] - place[0])[:2]) if len(place) > 2 else 0j

    @property
    def wrench(self) -> Floats:
        """Forces and torques (n, 6) [N, N m], less those of the point's reference."""
        return self.stored - self.offset


class Presses:
    """Streams of a session that its presses are in."""

    def __init__(self, session: Session, looked: dict[str, Any] | None = None) -> None:
        self.session = session
        self.looked = {} if looked is None else looked
        """Numbers of the pictures of each camera, kept while a session grows."""
        self._places: dict[int, tuple[Times, Floats]] = {}
        self._forces: dict[int, tuple[Times, NDArray[np.float32]]] = {}

    @cached_property
    def force(self) -> Stream | None:
        """Stream of the gauge; not an arm's own estimate."""
        name = self.session.first("force")
        return None if name is None else self.session.streams[name]

    @cached_property
    def pose(self) -> Stream | None:
        """Stream of the arm."""
        name = self.session.first("pose")
        return None if name is None else self.session.streams[name]

    @cached_property
    def frame(self) -> Floats | None:
        """Contact frame in the base frame (6,) [m, rad]."""
        frame = self.session.attrs.get("contact_frame")
        return None if frame is None else np.asarray(frame, np.float64)

    @cached_property
    def measured(self) -> tuple[int, ...]:
        """Axes that the gauge measures, by column."""
        names = None if self.force is None else self.force.attrs.get("axes_measured")
        return tuple(k for k, name in enumerate(AXES) if not names or name in names)

    @property
    def forces(self) -> list[int]:
        """Columns of the forces that the gauge measures."""
        return [axis for axis in self.measured if axis < 3]

    def values(self, first: int, stop: int) -> Floats:
        """Return rows [first, stop) of the gauge (n, 6)."""
        if self.force is None:
            return np.zeros((0, 6))
        return np.asarray(self.force.rows("value", slice(first, stop))[:], np.float64)

    @cached_property
    def sigma(self) -> Floats:
        """Noise of a sample of each axis (6,) [N, N m], by the median change between two."""
        change = np.abs(np.diff(self.values(0, NOISE_ROWS), axis=0))
        sigma = np.zeros(len(AXES))
        for axis in self.measured:
            known = change[np.isfinite(change[:, axis]), axis]
            # The median of |a - b| of normal noise is 0.954 of its standard deviation.
            sigma[axis] = float(np.median(known)) / 0.954 if known.size else 0.0
        return sigma

    def forces_of(self, run: int) -> tuple[Times, NDArray[np.float32]]:
        """Return times of capture (m,) [ns] in a run, in order, and measured forces (m, k) [N]."""
        if self.force is None:
            return np.zeros(0, np.int64), np.zeros((0, 0), np.float32)
        if run not in self._forces:
            rows = self.session.rows_of_run(self.force.name, run)
            values, times = self.force.rows("value", rows), align.captured(self.force)[rows]
            some = [values[part][:, self.forces] for part in blocks(len(times))]
            forces = np.concatenate([np.zeros((0, len(self.forces))), *some], dtype=np.float32)
            order = np.argsort(times, kind="stable")
            self._forces[run] = times[order], forces[order]
        return self._forces[run]

    def felt(self, *axes: int) -> float:
        """Return the least force on some axes [N] that is no noise of their gauge."""
        return NOISE * float(self.sigma[list(axes)].max()) + FELT

    def offset(self, run: int, target: int, t_ns: int) -> Floats:
        """Return the latest reference (6,) of a target's point before a time in a run, or NaN."""
        reference, targets = self.session.reference, self.session.targets
        if "point" not in targets or not len(reference["point"]) or "wrench" not in reference:
            return np.full(6, np.nan)
        point = np.asarray(targets["point"])[target]
        of_run = np.flatnonzero(np.asarray(reference["run"]) == run)
        same = of_run[np.asarray(reference["point"])[of_run] == point]
        rows = same if same.size else of_run
        if not rows.size:
            return np.full(6, np.nan)
        rows = rows[np.argsort(np.asarray(reference["t_ns"])[rows], kind="stable")]
        before = rows[np.asarray(reference["t_ns"])[rows] <= t_ns]
        row = before[-1] if before.size else rows[0]
        return np.array(reference["wrench"][row], np.float64)

    def places(self, run: int) -> tuple[Times, Floats]:
        """Return times (m,) [ns] and places (m, 3) [m] of the tip in the contact frame."""
        if self.pose is None or self.frame is None:
            return np.zeros(0, np.int64), np.zeros((0, 3))
        if run not in self._places:
            rows = self.session.rows_of_run(self.pose.name, run)
            poses = np.asarray(self.pose.array("value"), np.float64)[rows]
            with np.errstate(all="ignore"):
                self._places[run] = self.pose.t_ns[rows], in_frame(self.frame, poses)
        return self._places[run]

    def place(self, run: int, times: Times) -> Floats:
        """Return places of the tip (n, 3) [m] in the contact frame, or NaN, at times (n,) [ns]."""
        moments, places = self.places(run)
        if len(moments) < 2:
            return np.full((len(times), 3), np.nan)
        return np.asarray(align.linear(moments, places, times).value)

    def rows(self, stream: Stream, run: int, start: int, end: int) -> range:
        """Return the rows of a stream that arrived in a run from `start` up to `end` [ns]."""
        of_run = self.session.rows_of_run(stream.name, run)
        first, last = np.searchsorted(stream.t_ns[of_run], (start, end))
        return range((of_run.start or 0) + int(first), (of_run.start or 0) + int(last))

    @cached_property
    def _heights(self) -> Floats:
        return surface_heights(self.session)

    def height(self, target: int) -> float:
        """Return the height of the surface at the point of a target [m]."""
        return float(self._heights[target]) if target < len(self._heights) else 0.0

    @cached_property
    def phases(self) -> list[Phase]:
        """Phases in the order of their segments; without samples if there is no gauge."""
        return list(self._phases())

    def _phases(self) -> Iterator[Phase]:
        segments, force = self.session.segments, self.force
        for row in range(len(segments["target"])):
            run, target = int(segments["run"][row]), int(segments["target"][row])
            if not 0 <= target < len(self.session.targets.get("point", ())):
                continue  # a fault of the segments, or a session without targets
            start, end = int(segments["start_ns"][row]), int(segments["end_ns"][row])
            rows = range(0) if force is None else self.rows(force, run, start, end)
            yield Phase(
                target,
                int(segments["phase"][row]),
                int(segments["outcome"][row]) == 0,
                run,
                start,
                end,
                rows.start,
                len(rows),
                self.offset(run, target, start),
                self,
            )

    def of(self, *codes: int) -> list[Phase]:
        """Return the phases of these codes that have samples."""
        return [one for one in self.phases if one.code in codes and one.count]

    def planned(self, name: str, target: int) -> float:
        """Return a number of a target's plan, such as `depth` [m]; NaN if it has none."""
        column = self.session.targets.get(name)
        known = column is not None and target < len(column)
        return float(np.asarray(column)[target]) if known else float("nan")

    def planned_place(self, target: int) -> Floats:
        """Return the place that a target's press reaches (3,) [m] in the contact frame, or NaN."""
        planned = self.session.targets.get("planned")
        if planned is None or self.frame is None or target >= len(planned):
            return np.full(3, np.nan)
        return np.asarray(in_frame(self.frame, np.asarray(planned[target])[None])[0])
