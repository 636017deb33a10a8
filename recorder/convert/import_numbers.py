"""Numbers of files, topics and features as the content of a track: forces, taxels, poses, widths.

Forces are rounded to whole counts of 1 uN and 1 nN m (1e6 counts per N and per N mm, as usual for a
Net F/T box), so that a replay, which transmits counts, returns exactly the same bytes. This is a
thousand times finer than the resolution of such gauges. Counts of taxels are rounded to the
integers that the device transmits. The largest change is reported.
"""

import math
import re
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_tracks import (
    FORCE_UNITS,
    ORDERS,
    TORQUE_UNITS,
    Answers,
    As,
    Floats,
    MissingAnswer,
    Numbers,
    TaxelOrder,
    Times,
    kind_of_name,
    rate_of,
)
from recorder.errors import SessionError
from recorder.session.align import rotation_vector
from recorder.spec import AXES

# Nanoseconds per unit.
TIME_UNITS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
LENGTH_UNITS = {"m": 1.0, "mm": 1e-3}
ANGLE_UNITS = {"rad": 1.0, "deg": math.pi / 180}
POSE_AXES = ("X", "Y", "Z", "RX", "RY", "RZ")


def numbers_of(name: str, array: NDArray[Any], t_ns: Times, kind: As, answers: Answers) -> Numbers:
    """Return an array of numbers (n, ...) of a kind at times (n,) [ns] as the content of a track.

    `name` is the file, topic or feature, for messages.
    """
    if len(array) != len(t_ns):
        raise SessionError(f"{name}: found {len(array)} rows and {len(t_ns)} times")
    if kind == "force":
        return _forces(name, array, t_ns, answers)
    if kind == "taxels":
        return counts_of(name, array, t_ns, answers.taxel_order)
    rows = np.asarray(array, np.float64).reshape(len(array), -1)
    require_finite(rows, name)
    assumed: list[str] = []
    if kind == "pose":
        rows, assumed = _poses(name, rows)
    elif kind == "width":
        if rows.shape[1] != 1:
            raise SessionError(f"{name}: found shape {array.shape}; allowed for a width: (n,)")
        if answers.width_unit is None:
            raise MissingAnswer("width_unit", f"{name}: the width says no unit", ("m", "mm"))
        rows = rows * LENGTH_UNITS[answers.width_unit]
    return Numbers(rows, t_ns, rate_of(t_ns), assumed)


def _poses(name: str, rows: Floats) -> tuple[Floats, list[str]]:
    """Return position [m] and rotation vector (n, 6) of such, or of quaternions x y z w (n, 7)."""
    if rows.shape[1] == 6:
        return rows, [f"{name}: poses as position [m] and rotation vector [rad]"]
    if rows.shape[1] != 7:
        raise SessionError(
            f"{name}: found {rows.shape[1]} numbers a pose; allowed: 6 (rotation vector) or 7 "
            "(quaternion x y z w)"
        )
    length = np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    unit = rows[:, 3:] / np.where(length > 0, length, 1.0)
    return np.hstack([rows[:, :3], rotation_vector(unit[:, [3, 0, 1, 2]])]), []


def kind_of_array(shape: tuple[int, ...], name: str) -> As | None:
    """Return the kind of an array of numbers by name and shape; None if neither tells."""
    by_name = kind_of_name(name)
    if by_name is not None and by_name != "video":
        return by_name
    return "taxels" if shape[1:] in _TAXELS else None


# Content of a small file, and largest factor of compression of a large one.
_CONTENT, _COMPRESSED = 1 << 26, 20


def require_size(path: Path, nbytes: int) -> None:
    """Refuse a file whose content would fill the memory although the file is small."""
    allowed = _CONTENT + _COMPRESSED * path.stat().st_size
    if nbytes > allowed:
        raise SessionError(f"{path.name}: holds {nbytes} bytes; allowed in its size: {allowed}")


def load_arrays(path: Path, only: Collection[str] = ()) -> dict[str, NDArray[Any]]:
    """Return the numbers of an .npy or .npz file by source: the file, and in an .npz the array.

    `only` are the names of arrays in an .npz; without them all.
    """
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as file:
            require_size(path, sum(member.file_size for member in file.infolist()))
            if not file.namelist() or len(set(file.namelist())) < len(file.namelist()):
                raise SessionError(f"{path.name}: found no array, or two of one name")
    content = np.load(path, allow_pickle=False)
    inner = {"": content} if isinstance(content, np.ndarray) else content
    if missing := sorted({*only} - {*inner}):
        raise SessionError(f"{path.name}: found no array {missing}; it has {', '.join(inner)}")
    names = dict.fromkeys(only or inner)
    arrays = {f"{path.name}:{name}".removesuffix(":"): np.asarray(inner[name]) for name in names}
    for source, array in arrays.items():
        if array.dtype.kind not in "iuf":
            raise SessionError(f"{source}: found no array of numbers")
        if not len(array.shape) or not len(array):
            raise SessionError(f"{source}: found shape {array.shape}; expected at least one row")
    return arrays


def require_finite(rows: Floats, name: str, first_line: int = 0) -> None:
    """Refuse rows (n, k) with NaN or infinity; lines are counted from `first_line`, if not 0."""
    bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
    if bad.size:
        row_name = f"line {bad[0] + first_line}" if first_line else f"row {bad[0]}"
        raise SessionError(f"{name}: {row_name}: NaN or infinite ({bad.size} such rows)")


def parse_unit(text: str, factors: dict[str, float], where: str) -> float:
    """Return the SI factor of a unit; its parts may be separated (`N-mm`, `Nmm`, `N*mm`)."""
    plain = re.sub(r"[\s\-*·.]", "", text)
    for name, factor in factors.items():
        if plain == name.replace(" ", ""):
            return factor
    raise SessionError(f"{where}: found unit {text!r}; allowed: {', '.join(factors)}")


# Forces in whole counts, as a gauge sends them.

# Per N and, for torques, per N mm or N m.
COUNTS_PER_UNIT = 1e6
_COUNTS_MAX = 2**31 - 1
# Samples up to two periods old count as measured, however slow the recording was [s].
_MAX_AGE, _MAX_AGE_PERIODS = 0.02, 2.0


def _forces(name: str, numbers: NDArray[Any], t_ns: Times, answers: Answers) -> Numbers:
    """Return an array (n,), (n, 3) or (n, 6) at times (n,) [ns] as forces.

    An axis without a single number was not measured; any other NaN is refused.
    """
    if answers.units is None:
        raise MissingAnswer("units", f"{name}: forces say no unit", ("N", "mN", "gf", "kgf"))
    if numbers.ndim > 2 or (numbers.ndim == 2 and numbers.shape[1] not in (1, 3, 6)):
        raise SessionError(f"{name}: found shape {numbers.shape}; allowed: (n,), (n, 3), (n, 6)")
    array = numbers.astype(np.float64).reshape(len(numbers), -1)
    newton = parse_unit(answers.units, FORCE_UNITS, "--units")
    measured = ~np.isnan(array).all(axis=0)
    require_finite(array[:, measured] if measured.any() else array, name)
    value = np.full((len(array), 6), np.nan)
    axes, messages = [AXES[column] for column in np.flatnonzero(measured).tolist()], []
    if array.shape[1] == 1:
        value[:, 2], axes = -array[:, 0] * newton, ["Fz"]
        messages = [f"{name}: one force, positive when pressing, stored as -Fz"]
    else:
        value[:, :3] = array[:, :3] * newton
    if array.shape[1] == 6:
        if answers.torque_units is None:
            raise SessionError(
                f"{name}: torques say no unit; say --torque-units ({', '.join(TORQUE_UNITS)})"
            )
        factor = parse_unit(answers.torque_units, TORQUE_UNITS, "--torque-units")
        value[:, 3:] = array[:, 3:] * factor
    rate_hz = rate_of(t_ns)
    fine = np.nanmax(np.abs(value[:, 3:]), initial=0.0) * 1e3 * COUNTS_PER_UNIT <= _COUNTS_MAX
    scale = np.repeat([1.0 / COUNTS_PER_UNIT, (1e-3 if fine else 1.0) / COUNTS_PER_UNIT], 3)
    counts = np.rint(value / scale)
    beyond = np.flatnonzero((np.abs(counts) > _COUNTS_MAX).any(axis=1))
    if beyond.size:
        raise SessionError(
            f"{name}: row {beyond[0]}: {value[beyond[0]].tolist()} N, N m is beyond 2147; "
            "are the units right?"
        )
    counted = counts * scale
    change = np.abs(counted - value)
    force, torque = (float(np.nanmax(part, initial=0.0)) for part in (change[:, :3], change[:, 3:]))
    missing = [axis for axis in AXES if axis not in axes]
    if missing:
        messages.append(f"{name}: {', '.join(missing)} not measured, stored as NaN")
    messages.append(
        f"{name}: rounded to 1e-6 N and {'1e-9' if fine else '1e-6'} N m; "
        f"largest change {force:.2g} N, {torque:.2g} N m"
    )
    device = {
        "device": "imported",
        "force_unit": "N",
        "torque_unit": "N-mm" if fine else "N-m",
        "counts_per_force": COUNTS_PER_UNIT,
        "counts_per_torque": COUNTS_PER_UNIT,
        "rate_hz": rate_hz,
    }
    max_age = max(_MAX_AGE, _MAX_AGE_PERIODS / rate_hz)
    attrs = {"device": device, "axes_measured": axes, "max_age": max_age}
    return Numbers(counted, t_ns, rate_hz, messages, attrs)


# Counts of taxels, row by row.

_COUNT_MAX = 0xFFFF
# Shapes of a row, and the order that they state by themselves.
_TAXELS: dict[tuple[int, ...], TaxelOrder | None] = {(48,): None, (16, 3): "taxel", (3, 16): "axis"}
# Spread of the resting counts within an axis in the wrong order, over that in the right order, from
# which the order counts as known. In three logs of a uSkin it is 9.6 (x and y rest near 33,000
# counts, z near 20,000 or 45,000); without such a difference between the axes it is about 1.
_APART = 2.5
# Spread below which counts say nothing: a tared log has only noise [counts].
_SPREAD_LEAST = 100.0
# Rows of which the stillest ones in a row serve as the resting counts.
_RESTING_ROWS = 10


def counts_of(name: str, array: NDArray[Any], t_ns: Times, order: TaxelOrder | None) -> Numbers:
    """Return counts (n, 48), (n, 16, 3) or (n, 3, 16) taken at times (n,) [ns].

    Without an order of the numbers in a row, it is found by the resting counts, which differ more
    between the axes of a uSkin than between its taxels.
    """
    if array.shape[1:] not in _TAXELS or not len(array):
        raise SessionError(
            f"{name}: found shape {array.shape}; allowed: (n, 48), (n, 16, 3), (n, 3, 16)"
        )
    values = array.reshape(len(array), 48).astype(np.float64)
    whole = np.rint(values)
    sent = (whole >= 0) & (whole <= _COUNT_MAX)
    bad = np.flatnonzero(~sent.all(axis=1))
    if bad.size:
        raise SessionError(
            f"{name}: row {bad[0]}: found {values[~sent][0]:g}; allowed: 0 to {_COUNT_MAX} counts "
            f"({bad.size} such rows)"
        )
    assumed = []
    largest = float(np.abs(values - whole).max())
    if largest > 0:
        assumed.append(
            f"{name}: rounded to whole counts, as the device sends them; largest change "
            f"{largest:.3g} counts"
        )
    if order is None:
        order, why = _order_of(name, whole, _TAXELS[array.shape[1:]])
        assumed.append(why)
    return Numbers(in_order(whole, order).astype(np.int32), t_ns, rate_of(t_ns), assumed)


def in_order(rows: Floats, order: TaxelOrder) -> Floats:
    """Return rows (n, 3 m) of m taxels as (n, m, 3)."""
    count = rows.shape[1] // 3
    if order == "taxel":
        return rows.reshape(-1, count, 3)
    return rows.reshape(-1, 3, count).transpose(0, 2, 1)


def order_at_rest(rows: Floats) -> tuple[TaxelOrder | None, str]:
    """Return the order of rows (n, 3 m), None if it cannot be told, and the counts that tell it.

    A uSkin's taxels rest at similar counts along an axis, and far apart along different axes.
    """
    resting = _resting(rows)
    spread = {one: float(in_order(resting, one)[0].std(axis=0).mean()) for one in ORDERS}
    likely = min(ORDERS, key=lambda one: spread[one])
    within, across = spread[likely], max(spread.values())
    counts = f"resting counts spread {within:.0f} within an axis, {across:.0f} in the other order"
    return (likely if across >= _APART * max(within, _SPREAD_LEAST) else None), counts


def _order_of(name: str, rows: Floats, by_shape: TaxelOrder | None) -> tuple[TaxelOrder, str]:
    """Return the order of rows (n, 48), and a message on how it is known."""
    by_values, counts = order_at_rest(rows)
    if by_values is None:
        if by_shape is not None:
            return by_shape, f"{name}: order '{by_shape}' by its shape"
        raise SessionError(
            f"{name}: cannot tell the order of its 48 columns ({counts}); say --taxel-order taxel "
            "(x y z of each taxel) or --taxel-order axis (x of all taxels, then y, then z)"
        )
    if by_shape not in (None, by_values):
        raise SessionError(
            f"{name}: its shape says order '{by_shape}', its values '{by_values}' ({counts}); say "
            "--taxel-order taxel or --taxel-order axis"
        )
    return by_values, f"{name}: order '{by_values}' ({counts})"


def _resting(rows: Floats) -> Floats:
    """Return the mean of the stillest rows in a row, as (1, 3 m)."""
    count = min(_RESTING_ROWS, len(rows))
    begin = np.zeros((1, rows.shape[1]))
    totals = np.cumsum(np.concatenate([begin, rows]), axis=0)
    squares = np.cumsum(np.concatenate([begin, rows**2]), axis=0)
    mean = (totals[count:] - totals[:-count]) / count
    variance = (squares[count:] - squares[:-count]) / count - mean**2
    stillest = int(np.argmin(variance.sum(axis=1)))
    return np.asarray(mean[stillest : stillest + 1])
