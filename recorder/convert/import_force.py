"""Forces from a CSV or .npy file, quantised as by a Net F/T box.

They are rounded to whole counts of 1 uN and 1 nN m (1e6 counts per N and per N mm, as usual for a
Net F/T box), so that a replay, which transmits counts, returns exactly the same bytes. This is a
thousand times finer than the resolution of such gauges; the largest change is reported.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def parse_unit(text: str, known: dict[str, float], where: str) -> float:
    """Return the SI factor of a unit; its parts may be separated (`N-mm`, `Nmm`, `N*mm`).

    Raises:
        SessionError: The unit is not in `known`.
    """
    plain = re.sub(r"[\s\-*·.]", "", text)
    for name, factor in known.items():
        if plain == name.replace(" ", ""):
            return factor
    raise SessionError(f"{where}: found unit {text!r}; allowed: {', '.join(known)}")


def parse_header(
    names: list[str], *, force: str | None, torque: str | None, ignore: tuple[str, ...], where: str
) -> list[tuple[str, float] | None]:
    """Return the axis (or `t`) and factor of each column; None for an ignored one.

    Args:
        names: Names in the file, such as `Fx (N)`, `Tz[N mm]`, `time_ms`.
        force: Unit of force columns without a unit.
        torque: Unit of torque columns without a unit.
        ignore: Names of columns to leave out.
        where: The file, for error messages.

    Raises:
        SessionError: An unknown or repeated column, or one without a unit.
    """
    found: list[tuple[str, float] | None] = []
    for raw in names:
        name = raw.strip().lstrip("\ufeff").strip("'\"# ")
        if name in ignore:
            found.append(None)
            continue
        found.append(_column(name, force, torque, f"{where}: column {name!r}"))
    kept = [column[0] for column in found if column is not None]
    twice = sorted({name for name in kept if kept.count(name) > 1})
    if twice:
        raise SessionError(f"{where}: column {twice[0]} comes twice")
    if not set(kept) & set(AXES):
        raise SessionError(f"{where}: no force column; known: {', '.join(AXES)}")
    return found


def _column(name: str, force: str | None, torque: str | None, where: str) -> tuple[str, float]:
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
            (FORCE_UNITS, force, "--units")
            if axis[0] == "F"
            else (TORQUE_UNITS, torque, "--torque-units")
        )
        if unit is None and default is None:
            raise SessionError(f"{where}: says no unit; say {option} ({', '.join(known)})")
        return axis, parse_unit(unit or default or "", known, where)
    raise SessionError(
        f"{where}: not known; allowed: {', '.join(AXES)}, each with its unit, as Fx (N), and "
        f"{', '.join(_TIMES)} with theirs; leave others out with --ignore NAME"
    )


Floats = NDArray[np.float64]

# Per N and, for torques, per N mm or N m.
COUNTS_PER_UNIT = 1e6
_COUNTS_MAX = 2**31 - 1
# Samples up to two periods old count as measured, however slow the recording was [s].
_MAX_AGE, _MAX_AGE_PERIODS = 0.02, 2.0
_NEWTON_MILLIMETRE, _NEWTON_METRE = ("N-mm", 1e-3), ("N-m", 1.0)


@dataclass(frozen=True, slots=True)
class Wrenches:
    """Forces to import."""

    value: Floats
    """Values (n, 6) [N, N m], whole counts; NaN for axes that were not measured."""
    t_ns: NDArray[np.int64]
    """Times (n,) since the first row [ns]."""
    rate_hz: float
    """Rows per second."""
    attrs: dict[str, Any]
    """Stream attributes: device, axes_measured."""
    assumed: list[str] = field(default_factory=list)
    """Messages on assumptions and changes."""

    @property
    def seconds(self) -> float:
        """Duration [s]."""
        return float(self.t_ns[-1]) * 1e-9 + 1.0 / self.rate_hz


def read_force(
    path: Path,
    *,
    rate_hz: float | None,
    force_unit: str | None,
    torque_unit: str | None,
    ignore: tuple[str, ...] = (),
) -> Wrenches:
    """Return the forces of a file.

    Args:
        path: `.csv` with a header line, or `.npy`: (n,) pressing force, positive when pressing;
            (n, 3) Fx Fy Fz; (n, 6) with Tx Ty Tz.
        rate_hz: Rows per second, if no column gives times.
        force_unit: Unit of a `.npy` file, and of columns without a unit.
        torque_unit: The same for torques.
        ignore: Columns to leave out.

    Raises:
        SessionError: Invalid content; the message gives the place.
        OSError: The file cannot be read.
    """
    name = path.name
    if path.suffix.lower() == ".npy":
        value, axes, assumed = _from_npy(path, force_unit, torque_unit)
        t_ns = None
    elif path.suffix.lower() == ".csv":
        value, axes, t_ns = _from_csv(path, force_unit, torque_unit, ignore)
        assumed = []
    else:
        raise SessionError(f"{name}: found {path.suffix!r}; allowed: .csv, .npy")
    if t_ns is None:
        if rate_hz is None:
            raise SessionError(f"{name}: says no times; say --force-hz")
        t_ns = np.round(np.arange(len(value)) * (1e9 / rate_hz)).astype(np.int64)
        assumed.append(f"{name}: {rate_hz:g} rows/s by --force-hz")
    elif rate_hz is not None:
        raise SessionError(f"{name}: has a time column; --force-hz does not go with it")
    else:
        rate_hz = 1e9 / max(float(np.median(np.diff(t_ns))), 1.0) if len(t_ns) > 1 else 1.0
    missing = [axis for axis in AXES if axis not in axes]
    if missing:
        assumed.append(f"{name}: {', '.join(missing)} not measured, stored as NaN")
    counted, device, largest = _counted(value, name)
    assumed.append(
        f"{name}: rounded to 1e-6 N and "
        f"{'1e-9' if device['torque_unit'] == 'N-mm' else '1e-6'} N m; "
        f"largest change {largest[0]:.2g} N, {largest[1]:.2g} N m"
    )
    attrs = {
        "device": device | {"rate_hz": rate_hz},
        "axes_measured": axes,
        "max_age": max(_MAX_AGE, _MAX_AGE_PERIODS / rate_hz),
    }
    return Wrenches(counted, t_ns, rate_hz, attrs, assumed)


def load_npy(path: Path) -> NDArray[Any]:
    """Return the numbers of an .npy file.

    Raises:
        SessionError: Not an .npy file, truncated, or not numeric.
    """
    try:
        array: NDArray[Any] = np.load(path, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise SessionError(f"{path.name}: no whole .npy file of numbers: {error}") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
        raise SessionError(f"{path.name}: found no array of numbers")
    if not len(array.shape) or not len(array):
        raise SessionError(f"{path.name}: found shape {array.shape}; expected at least one row")
    return array


def _from_npy(
    path: Path, force_unit: str | None, torque_unit: str | None
) -> tuple[Floats, list[str], list[str]]:
    array = load_npy(path).astype(np.float64)
    if array.ndim == 2 and array.shape[1] == 1:
        array = array[:, 0]
    if array.ndim > 2 or (array.ndim == 2 and array.shape[1] not in (3, 6)):
        raise SessionError(f"{path.name}: found shape {array.shape}; allowed: (n,), (n, 3), (n, 6)")
    if force_unit is None:
        raise SessionError(f"{path.name}: says no unit; say --units ({', '.join(FORCE_UNITS)})")
    newton = parse_unit(force_unit, FORCE_UNITS, "--units")
    _refuse_bad(array.reshape(len(array), -1), path.name, 0)
    value = np.full((len(array), 6), np.nan)
    assumed = [f"{path.name}: {force_unit} by --units"]
    if array.ndim == 1:
        value[:, 2] = -array * newton
        assumed.append(f"{path.name}: one force, positive when pressing, stored as -Fz")
        return value, ["Fz"], assumed
    value[:, :3] = array[:, :3] * newton
    if array.shape[1] == 3:
        return value, list(AXES[:3]), assumed
    if torque_unit is None:
        raise SessionError(
            f"{path.name}: torques say no unit; say --torque-units ({', '.join(TORQUE_UNITS)})"
        )
    value[:, 3:] = array[:, 3:] * parse_unit(torque_unit, TORQUE_UNITS, "--torque-units")
    return value, list(AXES), assumed


def _from_csv(
    path: Path, force_unit: str | None, torque_unit: str | None, ignore: tuple[str, ...]
) -> tuple[Floats, list[str], NDArray[np.int64] | None]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = list(csv.reader(file))
    except (UnicodeDecodeError, csv.Error) as error:
        raise SessionError(f"{path.name}: no CSV text: {error}") from error
    if len(lines) < 2:
        raise SessionError(f"{path.name}: found {len(lines)} lines; expected a header and rows")
    columns = parse_header(
        lines[0], force=force_unit, torque=torque_unit, ignore=ignore, where=path.name
    )
    rows = np.zeros((len(lines) - 1, len(columns)))
    for place, line in enumerate(lines[1:]):
        if len(line) != len(columns):
            raise SessionError(
                f"{path.name}: line {place + 2}: found {len(line)} values, the header has "
                f"{len(columns)}; is the file cut short?"
            )
        for column, word in enumerate(line):
            if columns[column] is None:
                continue
            try:
                rows[place, column] = float(word)
            except ValueError:
                raise SessionError(
                    f"{path.name}: line {place + 2}: {lines[0][column].strip()}: found {word!r}, "
                    "expected a number"
                ) from None
    _refuse_bad(rows, path.name, 2)
    value = np.full((len(rows), 6), np.nan)
    axes, t_ns = [], None
    for column, meaning in enumerate(columns):
        if meaning is None:
            continue
        name, factor = meaning
        if name == "t":
            since = rows[:, column] - rows[0, column]
            t_ns = np.rint(since * factor).astype(np.int64)
        else:
            value[:, AXES.index(name)] = rows[:, column] * factor
            axes.append(name)
    if t_ns is not None and (backward := np.flatnonzero(np.diff(t_ns) <= 0)).size:
        raise SessionError(f"{path.name}: line {backward[0] + 3}: its time does not advance")
    return value, sorted(axes, key=AXES.index), t_ns


def _refuse_bad(rows: Floats, name: str, first_line: int) -> None:
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
