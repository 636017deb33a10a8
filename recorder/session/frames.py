"""The `frames` view: one row per tick of the sensor's rate, inside the recorded phases.

It is derived from the streams and can be rebuilt at any time; it contains no original data.
"""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.session.align import Floats, Times, align_window
from recorder.session.contact_frame import in_frame, surface_heights
from recorder.session.reader import Session, sources_near
from recorder.session.uncertainty import TimeSigma, row_sigma, sigmas_of
from recorder.spec import PHASES
from recorder.store.layout import write_table

Array = np.ndarray[Any, Any]

# Units and description of the columns of `frames` that every session has.
UNITS: Mapping[str, tuple[str, str]] = {
    "t_ns": ("ns", "tick, on the clock of the run"),
    "run": ("1", "entry of the session's attrs runs"),
    "image": ("1", "row of the first camera; -1 without one"),
    "is_duplicate": ("1", "same signal as in the row before"),
    "image_age": ("s", "tick minus capture of the signal; NaN without one"),
    "wrench": ("N, N m", "mean over the exposure, minus the offset of the point's reference"),
    "pose": ("m, rad", "tool pose at the capture, base frame, rotation vector"),
    "target": ("1", "row of targets; -1 in a session without targets"),
    "phase": ("1", "code, see attrs phases; -1 in a session without targets"),
    "depth": ("m", "indentation, from the pose; negative above the surface, NaN if unknown"),
    "skew": ("s", "largest distance of a value from the capture it is given for"),
    "time_sigma": ("s", "standard uncertainty of the alignment; twice it covers 95 %"),
    "valid": ("1", "every stream with a role had samples near enough, none of them lost or bad"),
}

# Ticks that are aligned at once.
_TICKS = 1 << 11

_BUILDING, _OLD = "frames.building", "frames.old"


def write_frames(path: Path, rate_hz: float) -> None:
    """Build the `frames` group of a session with closed streams, replacing an existing one.

    Only `seal` makes it durable.
    After a kill at any point, the group is either complete or absent; the next call rebuilds it.
    """
    building, old, final = path / _BUILDING, path / _OLD, path / "frames"
    remove_leftovers(path)
    session = Session(path)
    sigmas = sigmas_of(session)
    attrs = {
        "rate_hz": float(rate_hz),
        "phases": list(PHASES),
        "streams": session.columns,
        "time_sigma": [
            {name: part.to_json() for name, part in of_run.items()} for of_run in sigmas
        ],
    }
    write_table(building, frames_table(session, rate_hz, sigmas), frame_units(session), attrs)
    if final.exists():
        final.rename(old)
    building.rename(final)
    shutil.rmtree(old, ignore_errors=True)


def remove_leftovers(path: Path) -> bool:
    """Delete the leftovers of a killed build; return True if there were any."""
    leftovers = [path / name for name in (_BUILDING, _OLD) if (path / name).exists()]
    for leftover in leftovers:
        shutil.rmtree(leftover)
    return bool(leftovers)


def frames_table(
    session: Session, rate_hz: float, sigmas: Sequence[Mapping[str, TimeSigma]] | None = None
) -> dict[str, Array]:
    """Return the columns of the view, one row per tick that lies in a segment.

    Each run has one grid of ticks that starts with the run's first segment; rows never cross runs.
    The columns are those of `UNITS` and one for each aligned stream (see `spec.frame_columns`): its
    value, or the row of an image or a text. Streams named after themselves also have their distance
    to the capture, `<stream>_age`. In a session without targets, such as an imported one, the view
    covers each run from its first sample to its last. `sigmas` are those of each run, if they are
    known.
    """
    known = sigmas or sigmas_of(session)
    runs = session.run_ticks(rate_hz)
    parts = [part for run in runs for part in _parts_of_run(session, known[run[0]], *run)]
    if not parts:
        none = np.zeros(0, np.int64)
        parts += _parts_of_run(session, known[0], 0, none, none)
    # A column is taken out of its parts when it is joined, to need no memory for both.
    return {name: np.concatenate([part.pop(name) for part in parts]) for name in [*parts[0]]}


def _parts_of_run(
    session: Session,
    sigmas: Mapping[str, TimeSigma],
    run: int,
    ticks: Times,
    segment: NDArray[np.int64],
) -> Iterator[dict[str, Array]]:
    before = np.array([-1])
    for first in range(0, max(len(ticks), 1), _TICKS):
        here = slice(first, first + _TICKS)
        table = _part_table(session, run, ticks[here], segment[here], sigmas)
        row = table["is_duplicate"]  # of the signal
        table["is_duplicate"] = (row == np.r_[before, row][: len(row)]) & (row >= 0)
        before = row[-1:]
        yield table


def _part_table(
    session: Session,
    run: int,
    ticks: Times,
    segment: NDArray[np.int64],
    sigmas: Mapping[str, TimeSigma],
) -> dict[str, Array]:
    sources = sources_near(session.run_streams(run), ticks if len(ticks) else np.zeros(1, np.int64))
    rows = align_window(ticks, sources)
    count = len(ticks)
    target = _rows_of(session.segments["target"], segment, -1)
    signal = None if rows.signal is None else rows.streams[rows.signal]
    table: dict[str, Array] = {
        "t_ns": ticks,
        "run": np.full(count, run, np.int16),
        "image": np.full(count, -1, np.int64),
        "is_duplicate": rows.signal_row,
        "image_age": np.full(count, np.nan) if signal is None else signal.age,
        "wrench": np.full((count, 6), np.nan),
        "pose": np.full((count, 6), np.nan),
        "target": target,
        "phase": _rows_of(session.segments["phase"], segment, -1),
        "depth": np.full(count, np.nan),
        "skew": rows.skew,
        "time_sigma": row_sigma(rows, sources.streams, sigmas),
        "valid": rows.valid,
    }
    for name, column in rows.columns.items():
        stream = rows.streams[name]
        if stream.value is None:
            table[column] = np.asarray(stream.row)
        elif stream.traits.defaults.tared:
            offset = _reference_offset(session, run, ticks, target, column)
            table[column] = stream.value - offset
        else:
            table[column] = stream.value
        if column == name and column not in UNITS and column != stream.traits.defaults.column:
            table[f"{column}_age"] = stream.age
    frame = session.attrs.get("contact_frame")
    if frame is not None:
        table["depth"] = -in_frame(np.asarray(frame, np.float64), table["pose"])[:, 2]
        if len(heights := surface_heights(session)):
            table["depth"] += _rows_of(heights, target, 0.0)
    return table


def frame_units(session: Session) -> dict[str, tuple[str, str]]:
    """Return units and description of every column."""
    units = dict(UNITS)
    for name, column in session.columns.items():
        stream = session.streams[name]
        value, how = stream.value_column, stream.traits.align
        if column in UNITS:
            continue
        if value is None or not value.is_number:
            units[column] = ("1", f"row of streams/{name}, {how} at the capture; -1 without one")
        else:
            units[column] = (value.units, f"streams/{name}, {how} at the capture")
        units[f"{column}_age"] = ("s", f"distance of {column} from the capture; NaN without one")
    return units


def _rows_of(values: Array, rows: NDArray[Any], otherwise: float) -> Array:
    """Return the values (n,) of some rows; `otherwise` for a row that there is not."""
    known = (rows >= 0) & (rows < len(values))
    chosen = np.full(len(rows), otherwise, values.dtype)
    chosen[known] = values[rows[known]]
    return chosen


def resting(session: Session, column: str) -> Array:
    """Return a stream's values without contact: the first complete reference, else frame."""
    reference = session.reference[column]
    complete = np.flatnonzero(np.isfinite(reference).all(axis=tuple(range(1, reference.ndim))))
    return np.asarray(reference[complete[0]] if complete.size else session.frames[column][0])


def _reference_offset(
    session: Session, run: int, ticks: Times, target: NDArray[np.int32], column: str
) -> Floats:
    """Return the residual offset of each tick's contact point (n, 6) [N, N m].

    This is the latest reference of the point in this run, taken at or before the tick, else its
    first in this run; zero if there is none.
    """
    reference, targets = session.reference, session.targets
    has_references = "point" in targets and len(targets["point"]) and column in reference
    if not has_references or not len(reference["point"]):
        return np.zeros((len(ticks), 6))
    offset = np.zeros((len(ticks), *reference[column].shape[1:]))
    point = _rows_of(targets["point"], target, -1)
    known_points: set[int] = set()
    for row in np.argsort(reference["t_ns"], kind="stable"):
        if reference["run"][row] == run:
            here = point == reference["point"][row]
            if int(reference["point"][row]) in known_points:
                here &= ticks >= reference["t_ns"][row]
            known_points.add(int(reference["point"][row]))
            offset[here] = reference[column][row]
    return offset
