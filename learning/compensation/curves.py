"""Force over depth as it was measured: rows of an archive, or a session of `rig force-depth`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder import PHASES, Session
from recorder.session.press_curve import press_curves

Floats = NDArray[np.float64]
Table = Mapping[str, np.ndarray[Any, Any]]

DOWN, UP = PHASES.index("normal_inc"), PHASES.index("normal_dec")
INDENTER = "prism"
"""The flat, rigid indenter of the paper's material test (the paper, Methods)."""


@dataclass(frozen=True, slots=True, eq=False)
class ForceDepth:
    """What it took to press one sensor to some depths, all repeats together."""

    sensor: str
    indenter: str
    source: str
    """Where it was measured, in words."""
    loading: Floats
    """Depth [m] and compression [N] on the way down (n, 2)."""
    unloading: Floats
    """The same on the way up (m, 2)."""

    @property
    def depth_max(self) -> float:
        """Deepest depth [m]."""
        return float(max(self.loading[:, 0].max(), self.unloading[:, 0].max()))


def curve_of_table(sensor: str, table: Table, indenters: Sequence[str]) -> ForceDepth | None:
    """Return what force-depth rows of an archive's table say; None where there are none.

    Such rows have location -1 and the phase `normal_inc` or `normal_dec`. Rows that are not valid,
    or where nothing is touched (depth 0), are left out.

    Args:
        sensor: Name of the sensor.
        table: Its table.
        indenters: Names of the archive's indenters, by code.

    Raises:
        LearningError: Rows without a label, several indenters of which none is the paper's prism,
            or one of the two phases alone.
    """
    phase = table["phase"]
    rows = (table["location"] < 0) & table["valid"] & np.isin(phase, (DOWN, UP))
    if not rows.any():
        return None
    indenter = _indenter(sensor, table, rows, indenters)
    rows &= (table["indenter"] == indenters.index(indenter)) & (table["depth"] > 0)
    force = -table["wrench"][:, 2]
    unknown = np.flatnonzero(rows & ~np.isfinite(force))
    if unknown.size:
        raise LearningError(
            f"{sensor}.wrench: found NaN in row {unknown[0]} (and {unknown.size - 1} more) of the "
            "force-depth presses; allowed: numbers"
        )
    pairs = np.stack([table["depth"], force], axis=1)
    presses = len(np.unique(table["target"][rows]))
    return ForceDepth(
        sensor,
        indenter,
        f"{presses} force-depth presses of the archive",
        pairs[rows & (phase == DOWN)],
        pairs[rows & (phase == UP)],
    )


def curve_of_session(path: Path, sensor: str | None = None) -> ForceDepth:
    """Return what a session of `python -m rig force-depth` says.

    Args:
        path: The session.
        sensor: What its sensor is called; as the session says when None.

    Raises:
        LearningError: A session that does not say what it is of.
        SessionError: No session, or none in which a target was pressed and released.
    """
    session = Session(path)
    curves = press_curves(session)
    known = [session.attrs.get(name) for name in ("sensor", "indenter")]
    if not all(isinstance(name, str) and name for name in known):
        raise LearningError(
            f"{path}: found sensor {known[0]!r}, indenter {known[1]!r}; allowed: names"
        )
    return ForceDepth(
        sensor or str(known[0]),
        str(known[1]),
        f"session {path.name}",
        _known(curves.depth, curves.loading),
        _known(curves.depth, curves.unloading),
    )


def _indenter(sensor: str, table: Table, rows: NDArray[np.bool_], indenters: Sequence[str]) -> str:
    found = [str(indenters[code]) for code in np.unique(table["indenter"][rows])]
    if INDENTER in found:
        return INDENTER
    if len(found) > 1:
        raise LearningError(
            f"{sensor}: found force-depth presses of {', '.join(found)}; allowed: one indenter, or "
            f"{INDENTER} among them"
        )
    return found[0]


def _known(depth: Floats, force: Floats) -> Floats:
    """Return depth and force (n, 2) of curves (r, m) over common depths (m,), without gaps."""
    pairs = np.stack([np.broadcast_to(depth, force.shape), force], axis=-1).reshape(-1, 2)
    return pairs[np.isfinite(pairs[:, 1]) & (pairs[:, 0] > 0)]
