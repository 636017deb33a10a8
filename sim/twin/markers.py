"""Markers of a sensor at rest under presses, from the binary images of marker archives."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from recorder.archive import ArchivedSensor, MarkerArchive
from recorder.markers import find_blobs, smallest_marker, unpack
from sim.arrays import Array
from sim.errors import SceneError
from sim.sensors import CameraSignal, SimulatedSensor
from sim.twin.observations import PressTrack

Masks = NDArray[np.bool_]

# Longest time from a frame to the point of a track that it is taken for [s].
FRESH = 0.1
# Longest way of a marker between frames, in distances of neighbours: further is another marker.
GATE = 0.5
# Area over that of the median marker from which a patch is two of them.
MERGED = 1.5
# Largest part of the markers that is not found under contact.
LOST = 0.5
# Markers below which images tell no camera.
FEWEST = 6


@dataclass(frozen=True, slots=True, eq=False)
class MarkerObservations:
    """Markers of one reference image while the tip rests, at several points of one track."""

    track: PressTrack
    rows: NDArray[np.int64]
    """Points of the track (f,), the last of each rest in contact."""
    reference: Masks
    """Image without contact (480, 640)."""
    undeformed: Array
    """Column and row of the whole markers in it (m, 2) [px]."""
    observed: Array
    """The same at each point (f, m, 2) [px]; NaN where a marker was not found."""
    radius: float = 1.0
    """Radius of a disc as large as a marker [px]."""


def marker_observations(
    tracks: Sequence[PressTrack], archives: Sequence[MarkerArchive]
) -> list[MarkerObservations]:
    """Return the markers at points of tracks, in archives made from some of their sessions.

    Raises:
        SceneError: An archive has no frame of any of the tracks, or hardly any marker.
        SessionError: An archive is corrupt, or still being written.
    """
    observations: list[MarkerObservations] = []
    for archive in archives:
        sources = {
            sensor.name: [_source(line) for line in sensor.sources] for sensor in archive.values()
        }
        before = len(observations)
        for sensor in archive.values():
            for track in tracks:
                own = [each == (track.name, track.run) for each in sources[sensor.name]]
                rows = np.asarray(own, bool)[sensor.table["source"]] & sensor.table["valid"]
                observations += _observations(track, sensor, np.flatnonzero(rows))
        if len(observations) == before:
            sessions = sorted({str(name) for each in sources.values() for name, _ in each})
            raise SceneError(
                f"{archive.name}: is of {', '.join(sessions)}, and has no picture at rest in "
                f"contact of {', '.join(dict.fromkeys(track.name for track in tracks))}; allowed: "
                "an archive that tactile markers made from these sessions"
            )
    return observations


def _source(line: str) -> tuple[Any, Any]:
    """Return session and run of a frame, from its line of an archive's sources."""
    try:
        source = json.loads(line)
    except ValueError:
        return line, None
    return (source.get("session"), source.get("run")) if isinstance(source, dict) else (line, None)


def _observations(
    track: PressTrack, sensor: ArchivedSensor, rows: NDArray[np.int64]
) -> Iterator[MarkerObservations]:
    """Yield the markers in some rows of an archive along a track, for each of their references."""
    rows = rows[np.argsort(sensor.table["t_ns"][rows], kind="stable")]
    if not len(rows):
        return
    time = 1e-9 * (sensor.table["t_ns"][rows] - track.origin_ns)
    nearest = np.maximum(np.searchsorted(time, track.time, side="right") - 1, 0)
    fresh = np.abs(track.time - time[nearest]) <= FRESH
    rest = track.rest & track.contact & (track.target >= 0)
    ends = rest & ~np.r_[rest[1:], False]
    reference = sensor.table["reference"][rows[nearest]]
    for number in np.unique(reference[ends & fresh]):
        mask = unpack(sensor.references[number])
        follower = Follower.of(mask, f"{sensor.path}, reference {number}")
        points, positions = [], []
        for target in np.unique(track.target[ends]):
            follower.restart()
            of = np.flatnonzero((track.target == target) & fresh & (reference == number))
            for point, frame in zip(of, sensor.masks(rows[nearest[of]]), strict=True):
                tracked = follower.step(frame)
                if ends[point]:
                    points.append(point)
                    positions.append(tracked)
        lost = np.isnan(positions).mean() if positions else 0.0
        if lost > LOST:
            raise SceneError(
                f"{sensor.path}: {100 * lost:.0f} % of the markers of {track.name} are not found "
                f"under contact; allowed: up to {100 * LOST:.0f} %"
            )
        if positions:
            seen = follower.markers, np.array(positions), follower.radius
            yield MarkerObservations(track, np.array(points, np.int64), mask, *seen)


def camera_signal(sensor: SimulatedSensor) -> CameraSignal:
    """Return the signal of a sensor that has a camera."""
    if not isinstance(sensor.signal, CameraSignal):
        raise SceneError(f"{sensor.name}.signal: taxels; allowed: a camera, or no marker archive")
    return sensor.signal


class Follower:
    """Follows the markers (m, 2) [px] of a reference, each of an area [px], from frame to frame.

    A marker is the patch nearest to where it was, if that patch has no nearer marker.
    """

    def __init__(self, markers: Array, area: float) -> None:
        self.markers, self._area = markers, area
        apart, _ = cKDTree(markers).query(markers, k=2)
        self._gate = GATE * float(np.median(apart[:, 1]))
        self.restart()

    @classmethod
    def of(cls, mask: Masks, name: str) -> Self:
        """Return one of the whole markers in an image (480, 640) that errors call `name`."""
        blobs = find_blobs(mask[None], smallest_marker(mask))
        markers = blobs.centre[blobs.whole]
        if len(markers) < FEWEST:
            raise SceneError(f"{name}: {len(markers)} whole markers; allowed: {FEWEST} or more")
        return cls(markers, float(np.median(blobs.area)))

    @property
    def radius(self) -> float:
        """Radius of a disc as large as a marker [px]."""
        return math.sqrt(self._area / math.pi)

    def restart(self) -> None:
        """Expect the markers where they are without contact."""
        self._last = self.markers.copy()

    def step(self, mask: Masks) -> Array:
        """Return the markers in the next frame (m, 2) [px], NaN where they are not found."""
        blobs = find_blobs(mask[None], max(1, round(self._area / 5)))
        centres = blobs.centre[blobs.whole & (blobs.area < MERGED * self._area)]
        if not len(centres):
            return np.full_like(self._last, np.nan)
        apart, nearest = cKDTree(centres).query(self._last)
        _, back = cKDTree(self._last).query(centres)
        matched = (back[nearest] == np.arange(len(nearest))) & (apart <= self._gate)
        self._last = np.where(matched[:, None], centres[nearest], self._last)
        return np.where(matched[:, None], self._last, np.nan)
