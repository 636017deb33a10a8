"""Forces from a CSV or .npy file, quantised as by a Net F/T box.

They are rounded to whole counts of 1 uN and 1 nN m (1e6 counts per N and per N mm, as usual for a
Net F/T box), so that a replay, which transmits counts, returns exactly the same bytes. This is a
thousand times finer than the resolution of such gauges; the largest change is reported.
"""

from __future__ import annotations

import csv
import math
import re
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_answers import Answers, MissingAnswer
from recorder.convert.import_tracks import Floats, Numbers, Times, rate_of
from recorder.errors import SessionError
from recorder.spec import AXES

# Names of force and torque columns and their units, parsed strictly without guessing.

# Newton per unit.
FORCE_UNITS = {
    "N": 1.0,
    "mN": 1e-3,
    "kN": 1e3,
    "gf": 9.80665e-3,
    "kgf": 9.80665,
    "lbf": 4.4482216152605,
}
# Newton metre per unit.
TORQUE_UNITS = {
    "N m": 1.0,
    "N mm": 1e-3,
    "mN m": 1e-3,
    "kgf cm": 9.80665e-2,
    "lbf in": 0.1129848290276167,
}
# Nanoseconds per unit.
TIME_UNITS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}

_COLUMN = re.compile(
    r"^(?P<name>[A-Za-z]+)(?:\s*[(\[]\s*(?P<unit>[^)\]]+?)\s*[)\]]|_(?P<tail>\w+))?$"
)
_TIMES = ("t", "time", "timestamp")
# Columns of a CSV file that are no forces: word, name, units.
LENGTH_UNITS = {"m": 1.0, "mm": 1e-3}
ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180}
POSE_AXES = ("X", "Y", "Z", "RX", "RY", "RZ")
_OTHERS: dict[str, tuple[str, dict[str, float]]] = {
    **{axis.lower(): (axis, LENGTH_UNITS) for axis in POSE_AXES[:3]},
    **{axis.lower(): (axis, ANGLE_UNITS) for axis in POSE_AXES[3:]},
    **{word: ("width", LENGTH_UNITS) for word in ("width", "opening")},
}


def parse_unit(text: str, known: dict[str, float], where: str) -> float:
    """Return the SI factor of a unit; its parts may be separated (`N-mm`, `Nmm`, `N*mm`)."""
    plain = re.sub(r"[\s\-*·.]", "", text)
    for name, factor in known.items():
        if plain == name.replace(" ", ""):
            return factor
    raise SessionError(f"{where}: found unit {text!r}; allowed: {', '.join(known)}")


def parse_header(names: list[str], answers: Answers, where: str) -> list[tuple[str, float] | None]:
    """Return the axis (or `t`) and factor of each column; None for an ignored one.

    Args:
        names: Names in the file, such as `Fx (N)`, `Tz[N mm]`, `time_ms`.
        answers: Units of columns without one, and names of columns to leave out.
        where: The file, for error messages.
    """
    columns: list[tuple[str, float] | None] = []
    for raw in names:
        name = raw.strip().lstrip("\ufeff").strip("'\"# ")
        if name in answers.ignore:
            columns.append(None)
        else:
            columns.append(_column(name, answers, f"{where}: column {name!r}"))
    kept = [column[0] for column in columns if column is not None]
    twice = sorted({name for name in kept if kept.count(name) > 1})
    if twice:
        raise SessionError(f"{where}: column {twice[0]} comes twice")
    if not set(kept) & {*AXES, "width", *POSE_AXES}:
        raise SessionError(f"{where}: no force column; known: {', '.join(AXES)}")
    return columns


def _column(name: str, answers: Answers, where: str) -> tuple[str, float]:
    match = _COLUMN.match(name)
    word = match["name"].lower() if match else ""
    unit = (match["unit"] or match["tail"]) if match else None
    if word in _TIMES:
        if unit is None:
            raise SessionError(f"{where}: says no unit; name it such as {name}_s or {name} (ms)")
        return "t", parse_unit(unit, TIME_UNITS, where)
    for axis in AXES:
        if word != axis.lower():
            continue
        known, default, option = (
            (FORCE_UNITS, answers.units, "--units")
            if axis[0] == "F"
            else (TORQUE_UNITS, answers.torque_units, "--torque-units")
        )
        if unit is None and default is None:
            raise SessionError(f"{where}: says no unit; say {option} ({', '.join(known)})")
        return axis, parse_unit(unit or default or "", known, where)
    if word in _OTHERS:
        name, units = _OTHERS[word]
        if unit is None:
            raise SessionError(f"{where}: says no unit; allowed: {', '.join(units)}")
        return name, parse_unit(unit, units, where)
    raise SessionError(
        f"{where}: not known; allowed: {', '.join(AXES)}, each with its unit, as Fx (N), and "
        f"{', '.join(_TIMES)} with theirs; leave others out with --ignore NAME"
    )


# Per N and, for torques, per N mm or N m.
COUNTS_PER_UNIT = 1e6
_COUNTS_MAX = 2**31 - 1
# Samples up to two periods old count as measured, however slow the recording was [s].
_MAX_AGE, _MAX_AGE_PERIODS = 0.02, 2.0
_NEWTON_MILLIMETRE, _NEWTON_METRE = ("N-mm", 1e-3), ("N-m", 1.0)


def wrenches_of(
    name: str,
    value: Floats,
    axes: list[str],
    t_ns: Times,
    *,
    rate_hz: float | None = None,
    assumed: list[str],
) -> Numbers:
    """Return forces (n, 6) [N, N m] at times (n,) [ns] in whole counts, as a gauge sends them.

    Args:
        name: The file, for messages.
        value: Forces and torques; NaN on axes that were not measured.
        axes: Those that were.
        t_ns: Times since the start of the recording.
        rate_hz: Rows per second; None: by the times.
        assumed: Messages so far.
    """
    rate_hz = rate_hz or rate_of(t_ns)
    missing = [axis for axis in AXES if axis not in axes]
    messages = list(assumed)
    if missing:
        messages.append(f"{name}: {', '.join(missing)} not measured, stored as NaN")
    counted, device, largest = _counted(value, name)
    messages.append(
        f"{name}: rounded to 1e-6 N and "
        f"{'1e-9' if device['torque_unit'] == 'N-mm' else '1e-6'} N m; "
        f"largest change {largest[0]:.2g} N, {largest[1]:.2g} N m"
    )
    attrs = {
        "device": device | {"rate_hz": rate_hz},
        "axes_measured": axes,
        "max_age": max(_MAX_AGE, _MAX_AGE_PERIODS / rate_hz),
    }
    return Numbers(counted, t_ns, rate_hz, messages, attrs)


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the numbers of an .npy or .npz file by source: the file, and in an .npz the array."""
    try:
        content = np.load(path, allow_pickle=False)
        if isinstance(content, np.ndarray):
            arrays = {path.name: content}
        else:
            with content:
                arrays = {f"{path.name}:{name}": content[name] for name in content.files}
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        suffix = path.suffix.lower()
        raise SessionError(f"{path.name}: no whole {suffix} file of numbers: {error}") from error
    for source, array in arrays.items():
        if array.dtype.kind not in "iuf":
            raise SessionError(f"{source}: found no array of numbers")
        if not len(array.shape) or not len(array):
            raise SessionError(f"{source}: found shape {array.shape}; expected at least one row")
    return arrays


def forces_of_array(name: str, numbers: NDArray[Any], t_ns: Times, answers: Answers) -> Numbers:
    """Return an array (n,), (n, 3) or (n, 6) at times (n,) [ns] as forces in whole counts.

    An axis without a single number was not measured; any other NaN is refused.
    """
    if answers.units is None:
        raise MissingAnswer("units", f"{name}: forces say no unit", ("N", "mN", "gf", "kgf"))
    if numbers.ndim > 2 or (numbers.ndim == 2 and numbers.shape[1] not in (1, 3, 6)):
        raise SessionError(f"{name}: found shape {numbers.shape}; allowed: (n,), (n, 3), (n, 6)")
    array = numbers.astype(np.float64).reshape(len(numbers), -1)
    newton = parse_unit(answers.units, FORCE_UNITS, "--units")
    measured = ~np.isnan(array).all(axis=0)
    require_finite(np.where(measured, array, 0.0) if array.shape[1] > 1 else array, name)
    value = np.full((len(array), 6), np.nan)
    assumed = [f"{name}: {answers.units} by --units"]
    if array.shape[1] == 1:
        value[:, 2] = -array[:, 0] * newton
        assumed.append(f"{name}: one force, positive when pressing, stored as -Fz")
        return wrenches_of(name, value, ["Fz"], t_ns, assumed=assumed)
    value[:, :3] = array[:, :3] * newton
    if array.shape[1] == 6:
        if answers.torque_units is None:
            raise SessionError(
                f"{name}: torques say no unit; say --torque-units ({', '.join(TORQUE_UNITS)})"
            )
        factor = parse_unit(answers.torque_units, TORQUE_UNITS, "--torque-units")
        value[:, 3:] = array[:, 3:] * factor
    axes = [AXES[column] for column in np.flatnonzero(measured).tolist()]
    return wrenches_of(name, value, axes, t_ns, assumed=assumed)


@dataclass(frozen=True, slots=True)
class Table:
    """Known columns of a CSV file."""

    columns: dict[str, Floats]
    """Values (n,) in SI units by name: axes of `AXES` and `POSE_AXES`, and `width`."""
    t_ns: NDArray[np.int64] | None
    """Times (n,) since the first row [ns]; None without a time column."""

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(next(iter(self.columns.values())))


def read_lines(path: Path) -> list[list[str]]:
    """Return the words of a CSV file, line by line, the first of which may be a header."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = list(csv.reader(file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise SessionError(f"{path.name}: no CSV text: {error}") from error
    if len(lines) < 2:
        raise SessionError(f"{path.name}: found {len(lines)} lines; expected a header and rows")
    return lines


def read_table(name: str, lines: list[list[str]], answers: Answers) -> Table:
    """Return the known columns of a CSV file by its header.

    Args:
        name: The file, for messages.
        lines: Its words, the header first.
        answers: Units that the file does not state, and columns to leave out.
    """
    columns = parse_header(lines[0], answers, name)
    rows = read_rows(name, lines, [place for place, each in enumerate(columns) if each is not None])
    known: dict[str, Floats] = {}
    t_ns = None
    for column, meaning in enumerate(columns):
        if meaning is None:
            continue
        word, factor = meaning
        if word == "t":
            since = rows[:, column] - rows[0, column]
            t_ns = np.rint(since * factor).astype(np.int64)
        else:
            known[word] = rows[:, column] * factor
    if t_ns is not None and (backward := np.flatnonzero(np.diff(t_ns) <= 0)).size:
        raise SessionError(f"{name}: line {backward[0] + 3}: its time does not advance")
    return Table(known, t_ns)


def read_rows(name: str, lines: list[list[str]], used: list[int], first: int = 1) -> Floats:
    """Return the numbers of the lines from `first` on; 0 in columns that are not used."""
    rows = np.zeros((len(lines) - first, len(lines[0])))
    for place, line in enumerate(lines[first:]):
        number = place + first + 1
        if len(line) != len(lines[0]):
            raise SessionError(
                f"{name}: line {number}: found {len(line)} values, the header has "
                f"{len(lines[0])}; is the file cut short?"
            )
        for column in used:
            try:
                rows[place, column] = float(line[column])
            except ValueError:
                raise SessionError(
                    f"{name}: line {number}: {lines[0][column].strip()}: found {line[column]!r}, "
                    "expected a number"
                ) from None
    require_finite(rows, name, first + 1)
    return rows


def forces_of(table: Table) -> tuple[Floats, list[str]]:
    """Return the forces of a table (n, 6), NaN on axes that it lacks, and the axes that it has."""
    value = np.full((len(table), len(AXES)), np.nan)
    axes = [axis for axis in AXES if axis in table.columns]
    for axis in axes:
        value[:, AXES.index(axis)] = table.columns[axis]
    return value, axes


def require_finite(rows: Floats, name: str, first_line: int = 0) -> None:
    """Refuse rows (n, k) with NaN or infinity; lines are counted from `first_line`, if not 0."""
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if bad.size:
        where = f"line {bad[0] + first_line}" if first_line else f"row {bad[0]}"
        raise SessionError(f"{name}: {where}: NaN or infinite ({bad.size} such rows)")


def _counted(value: Floats, name: str) -> tuple[Floats, dict[str, Any], tuple[float, float]]:
    """Return `value` in whole counts, device attributes, largest change of force and torque."""
    fine = np.nanmax(np.abs(value[:, 3:]), initial=0.0) * 1e3 * COUNTS_PER_UNIT <= _COUNTS_MAX
    torque_unit, per_unit = _NEWTON_MILLIMETRE if fine else _NEWTON_METRE
    scale = np.repeat([1.0 / COUNTS_PER_UNIT, per_unit / COUNTS_PER_UNIT], 3)
    counts = np.rint(value / scale)
    beyond = np.flatnonzero((np.abs(counts) > _COUNTS_MAX).any(axis=1))
    if beyond.size:
        raise SessionError(
            f"{name}: row {beyond[0]}: {value[beyond[0]].tolist()} N, N m is beyond 2147; "
            "are the units right?"
        )
    counted = counts * scale
    change = np.abs(counted - value)
    device = {
        "device": "imported",
        "force_unit": "N",
        "torque_unit": torque_unit,
        "counts_per_force": COUNTS_PER_UNIT,
        "counts_per_torque": COUNTS_PER_UNIT,
    }
    return counted, device, (_largest(change[:, :3]), _largest(change[:, 3:]))


def _largest(change: Floats) -> float:
    return float(np.nanmax(change, initial=0.0))
