"""Arrays of numbers as the content of a track, by their kind."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_answers import Answers, As, MissingAnswer
from recorder.convert.import_force import LENGTH_UNITS, forces_of_array, require_finite
from recorder.convert.import_taxels import counts_of, is_taxels
from recorder.convert.import_tracks import Floats, Numbers, Times, kind_of_name, rate_of
from recorder.errors import SessionError
from recorder.session.align import rotation_vector


def numbers_of(name: str, array: NDArray[Any], t_ns: Times, kind: As, answers: Answers) -> Numbers:
    """Return an array of numbers (n, ...) at times (n,) [ns] as the content of a track.

    Args:
        name: File, topic or feature, for messages.
        array: Numbers, row by row.
        t_ns: Times of the rows.
        kind: What they are, other than `video` and `skip`.
        answers: Units, and the order of the counts of taxels.
    """
    if len(array) != len(t_ns):
        raise SessionError(f"{name}: found {len(array)} rows and {len(t_ns)} times")
    if kind == "force":
        return forces_of_array(name, array, t_ns, answers)
    if kind == "taxels":
        return counts_of(name, array, t_ns, answers.taxel_order)
    rows = np.asarray(array, np.float64).reshape(len(array), -1)
    require_finite(rows, name)
    if kind == "pose":
        return _pose(name, rows, t_ns)
    if kind == "width":
        if rows.shape[1] != 1:
            raise SessionError(f"{name}: found shape {array.shape}; allowed for a width: (n,)")
        if answers.width_unit is None:
            raise MissingAnswer("width_unit", f"{name}: the width says no unit", ("m", "mm"))
        rows = rows * LENGTH_UNITS[answers.width_unit]
    return Numbers(rows, t_ns, rate_of(t_ns))


def _pose(name: str, rows: Floats, t_ns: Times) -> Numbers:
    """Return poses of positions [m] and rotation vectors (n, 6) or quaternions x y z w (n, 7)."""
    if rows.shape[1] == 6:
        message = f"{name}: poses as position [m] and rotation vector [rad]"
        return Numbers(rows, t_ns, rate_of(t_ns), [message])
    if rows.shape[1] != 7:
        raise SessionError(
            f"{name}: found {rows.shape[1]} numbers a pose; allowed: 6 (rotation vector) or 7 "
            "(quaternion x y z w)"
        )
    length = np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    unit = rows[:, 3:] / np.where(length > 0, length, 1.0)
    turned = rotation_vector(unit[:, [3, 0, 1, 2]])
    return Numbers(np.hstack([rows[:, :3], turned]), t_ns, rate_of(t_ns))


def kind_of_array(shape: tuple[int, ...], name: str) -> As | None:
    """Return the kind of an array of numbers by name and shape; None if neither tells."""
    by_name = kind_of_name(name)
    if by_name is not None and by_name != "video":
        return by_name
    return "taxels" if is_taxels(shape) else None
