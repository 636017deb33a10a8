"""Observations of a twin: the tip's path through a session, and the force at points of it."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from recorder.session import Session, in_frame
from sim.arrays import Array
from sim.errors import SceneError
from trajectories import dome_height

# Tips higher than this above the surface touch nothing [m].
FREE = 0.1e-3
# Points per deepest press along the tip's path; sideways they are as far apart as the second says.
POINTS, SIDEWAYS = 4, 0.2e-3
# Shortest time between points of a resting tip [s], and growth of that time over the rest so far.
SOONEST, GROWTH = 0.05, 0.8
# Longest time between points without contact [s].
IDLE = 0.5
# A tip that has moved less than this since the last point, within `SOONEST`, is at rest [m].
STILL = 2e-6
# The same over the noise of the poses, if that is more.
NOISY = 6.0
# Time after a move in which forces may still belong to it, however late they are read [s].
SETTLING = 0.06
# Half of the longest and of the shortest time over which a force is averaged [s].
WINDOW, WINDOW_LEAST = 0.2, 0.003
# Time before a contact over which its zero is averaged [s].
ZERO = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class PressTrack:
    """Path of one indenter over a sensor, and the forces along it."""

    name: str
    """Where it is from."""
    indenter: str
    time: Array
    """Time of each point (n,) [s], rising."""
    tip: Array
    """Tip at each point (n, 3) [m], z above the undeformed surface there."""
    force: Array
    """Mean force around each point (n, 3) [N], on the sensor: pressing is negative z."""
    noise: Array
    """Standard deviation of that mean by the gauge's noise (n,) [N]."""
    target: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """Press that each point belongs to (n,), -1 in between."""
    run: int = 0
    """Run of the session."""
    origin_ns: int = 0
    """Time 0 on the clock of that run [ns]."""
    still: float = STILL
    """A tip that moves less between two points is at rest [m]."""

    @property
    def rest(self) -> NDArray[np.bool_]:
        """True for points at which the tip has not moved for `SETTLING` (n,)."""
        at_rest = np.zeros(len(self.time), bool)
        since = self.time[0]
        for row in range(1, len(self.time)):
            if np.linalg.norm(self.tip[row] - self.tip[row - 1]) > self.still:
                since = self.time[row]
            at_rest[row] = self.time[row] - since >= SETTLING
        return at_rest

    @property
    def contact(self) -> NDArray[np.bool_]:
        """True for points below the surface, or with a force above noise (n,)."""
        size = np.linalg.norm(self.force, axis=1)
        return np.asarray((self.tip[:, 2] < 0) | (size > 5 * self.noise))


def tracks_of(session: Session, *, gauge: bool = True) -> list[PressTrack]:
    """Return the tracks of a session, one for each run; without its gauge forces are 0.

    Raises:
        SceneError: It has no gauge, no arm, no contact frame, or no contact.
    """
    force, pose = session.first("force"), session.first("pose")
    force = force if gauge else pose
    frame = session.attrs.get("contact_frame")
    for name, value in (("stream of kind force", force), ("stream of kind pose", pose)):
        if value is None:
            raise SceneError(
                f"{session.name}: no {name}; allowed: sessions with forces and the arm's poses"
            )
    if frame is None or "indenter" not in session.attrs:
        raise SceneError(f"{session.name}: no contact_frame or indenter; allowed: both")
    assert force is not None
    assert pose is not None
    tracks = []
    for run in range(max(len(session.runs), 1)):
        poses, forces = session.streams[pose], session.streams[force]
        at, of = session.rows_of_run(pose, run), session.rows_of_run(force, run)
        if at.stop - at.start < 2 or of.stop - of.start < 2:
            continue
        origin = int(poses.t_ns[at][0])
        track = track_of(
            session.path.name,
            str(session.attrs["indenter"]),
            np.asarray(1e-9 * (poses.t_ns[at] - origin), float),
            in_frame(np.asarray(frame, float), np.asarray(poses.array("value"))[at]),
            np.asarray(1e-9 * (forces.t_ns[of] - origin), float),
            np.asarray(forces.array("value"), float)[of][:, :3] * gauge,
            dome_radius=(session.attrs.get("plan") or {}).get("dome_radius"),
        )
        if track is not None:
            tracks.append(replace(track, run=run, origin_ns=origin))
    if not tracks:
        raise SceneError(f"{session.name}: the tip never went below the surface; allowed: presses")
    return tracks


def track_of(
    name: str,
    indenter: str,
    time: Array,
    tip: Array,
    force_time: Array,
    force: Array,
    *,
    dome_radius: float | None = None,
) -> PressTrack | None:
    """Return the track of poses (n,), (n, 3) and forces (m,), (m, 3) [s, m, N].

    Forces without contact are taken as zero: the mean of the last of them before each press is
    removed. None if the tip never went below the surface.
    """
    tip = tip.copy()
    if dome_radius is not None:
        tip[:, 2] -= [dome_height(dome_radius, x, y) for x, y in tip[:, :2]]
    if tip[:, 2].min() >= 0:
        return None
    inside = (force_time >= time[0]) & (force_time <= time[-1]) & np.isfinite(force).all(axis=1)
    force_time, force = force_time[inside], force[inside]
    height = np.interp(force_time, time, tip[:, 2])
    free = height > FREE
    if not free.any():
        raise SceneError(
            f"{name}: no force without contact; allowed: presses that begin above {1e3 * FREE:g} mm"
        )
    noise = float(force[free].std(axis=0).max())
    force = force - _zeros(force_time, force, free)
    still = max(STILL, NOISY * _jitter(tip))
    points = _points(time, tip, still)
    step = np.diff(time[points])
    reach = np.minimum(np.r_[step, step[-1]], np.r_[step[0], step])
    half = np.clip(0.4 * reach, WINDOW_LEAST, WINDOW)
    start, stop = time[points] - half, time[points] + half
    mean, count = _means(force_time, force, start, stop)
    below = tip[points, 2] <= FREE
    target = np.where(below, np.cumsum(np.diff(np.r_[False, below].astype(int)) > 0) - 1, -1)
    track = PressTrack(
        name=name,
        indenter=indenter,
        time=time[points],
        tip=tip[points],
        force=mean,
        noise=noise / np.sqrt(count),
        target=target.astype(np.int64),
        still=still,
    )
    if still == STILL:
        return track
    positions, _ = _means(time, tip, start, stop)
    return replace(track, tip=np.where(track.rest[:, None], positions, track.tip))


def _jitter(tip: Array) -> float:
    """Return the standard deviation of the noise of tips (n, 3) [m], on the noisiest axis.

    It is that of second differences, by their median: most of a path is straight.
    """
    bent = np.median(np.abs(np.diff(tip, 2, axis=0)), axis=0) if len(tip) > 2 else np.zeros(3)
    # A normal distribution has half of its values within 0.6745 standard deviations.
    return float(bent.max()) / (0.6745 * math.sqrt(6))


def _means(
    time: Array, values: Array, start: Array, stop: Array
) -> tuple[Array, NDArray[np.int64]]:
    """Return means (n, 3) of values (m, 3) between times (n,), of one at least, and their count."""
    first = np.searchsorted(time, start)
    last = np.maximum(np.searchsorted(time, stop, side="right"), first + 1)
    last = np.minimum(last, len(time))
    first = np.minimum(first, last - 1)
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(values, axis=0)])
    count = last - first
    return (sums[last] - sums[first]) / count[:, None], count


def _zeros(time: Array, force: Array, free: NDArray[np.bool_]) -> Array:
    """Return the zero of each sample (m, 3): the mean of those free before its contact."""
    zeros = np.repeat(force[free].mean(axis=0)[None], len(force), axis=0)
    starts = np.flatnonzero(np.diff(free.astype(int)) < 0) + 1
    for index, start in enumerate(starts):
        stop = starts[index + 1] if index + 1 < len(starts) else len(force)
        before = np.flatnonzero(free[:start] & (time[:start] > time[start] - ZERO))
        if len(before) > 20:
            zeros[start:stop] = force[before].mean(axis=0)
    return zeros


def _points(time: Array, tip: Array, still: float) -> NDArray[np.int64]:
    """Return rows at which to solve: evenly along the path, ever rarer while the tip rests.

    Those where the tip starts and stops are among them: a stop that is missing would be a slower
    move that goes on into the rest, and drags the skin for longer. A tip that moves less than
    `still` [m] is at rest.
    """
    step = -tip[:, 2].min() / POINTS
    ahead = np.minimum(np.searchsorted(time, time + SOONEST / 2), len(time) - 1)
    moves = np.abs(tip[ahead] - tip).max(axis=1) > still
    turns = np.r_[False, moves[1:] != moves[:-1]]
    rows, since = [0], time[0]
    for row in range(1, len(time)):
        last = rows[-1]
        passed = time[row] - time[last]
        if tip[row, 2] > FREE and tip[last, 2] > FREE:
            if passed >= IDLE:
                rows.append(row)
            continue
        if tip[last, 2] > FREE and last != row - 1:
            rows.append(row - 1)  # the last one without contact, so that the way down is straight
            since = time[row]
            continue
        way = tip[row] - tip[last]
        moved = abs(way[2]) >= step or np.hypot(way[0], way[1]) >= SIDEWAYS
        moved |= turns[row] and tip[row, 2] <= FREE
        if not moved and passed < SOONEST:
            continue
        if moved or np.abs(way).max() > still:
            since = time[row]
            rows.append(row)
        elif passed >= GROWTH * (time[last] - since):
            rows.append(row)
    return np.array(rows, np.int64)
