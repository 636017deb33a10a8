"""Location pairs: frames of two sensors that were pressed at the same place, in the same phase.

Four frames of each press are paired: the last of each of its four phases (the supplement). The
authors' code takes the press's first frame, before contact, instead of the last of `normal_dec`:
preset `authors_code`. Frames without a phase, as in presses without shear, are also paired by
their last one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.errors import SessionError
from recorder.spec import PHASES

Array = np.ndarray[Any, Any]
Table = Mapping[str, Array]

# Choices of the four paired frames of a press.
PRESETS = ("supplement", "authors_code")

_UNLOADED = PHASES.index("normal_dec")
_FIRST = len(PHASES)  # code of the first frame, used in place of a phase code
_CODES = len(PHASES) + 2  # the phases, no phase, and the first frame


def press_rows(table: Table, *parts: str) -> dict[tuple[int, ...], NDArray[np.int64]]:
    """Return the rows of each press of a sensor, in order of their frames.

    They are (k,), by location and values of `parts`, integer columns that divide a press, such as
    `phase`; ascending. A location belongs to one press. Rows that are not valid, and those without
    a location, belong to none.
    """
    rows = np.flatnonzero((table["location"] >= 0) & table["valid"]).astype(np.int64)
    if not len(rows):
        return {}
    keys = [np.asarray(table[name][rows], np.int64) for name in ("location", *parts)]
    order = np.lexsort((table["frame"][rows], *reversed(keys)))
    rows, key = rows[order], np.stack(keys, axis=1)[order]
    starts = np.flatnonzero(np.r_[True, (np.diff(key, axis=0) != 0).any(axis=1)])
    parted = np.split(rows, starts[1:])
    return dict(zip(map(tuple, key[starts].tolist()), parted, strict=True))


@dataclass(frozen=True, slots=True)
class LocationPairs:
    """Paired rows, ascending by location and then by phase."""

    source: NDArray[np.int64]
    """Rows of the source sensor (n,)."""
    target: NDArray[np.int64]
    """Rows of the target sensor (n,)."""

    def __len__(self) -> int:
        return len(self.source)


def location_pairs(source: Table, target: Table, preset: str = "supplement") -> LocationPairs:
    """Return the location pairs of two sensors' tables by one of `PRESETS`.

    Locations or phases that only one of them has, and rows that are not valid, are left out.

    Raises:
        SessionError: An unknown preset, or a location shared by several presses of one sensor.
    """
    if preset not in PRESETS:
        raise SessionError(f"preset: found {preset!r}; known: {', '.join(PRESETS)}")
    source_keys, source_rows = _chosen(source, preset)
    target_keys, target_rows = _chosen(target, preset)
    _, one, other = np.intersect1d(
        source_keys, target_keys, assume_unique=True, return_indices=True
    )
    return LocationPairs(source_rows[one], target_rows[other])


def _chosen(table: Table, preset: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return unique keys of location and phase, ascending, and the row of each."""
    rows = np.flatnonzero((table["location"] >= 0) & table["valid"])
    _require_one_press(*(table[name][rows] for name in ("location", "indenter", "target")))
    chosen = {
        location * _CODES + phase: int(part[-1])
        for (location, phase), part in press_rows(table, "phase").items()
        if preset != "authors_code" or phase != _UNLOADED
    }
    if preset == "authors_code":
        for (location,), part in press_rows(table).items():
            if (table["phase"][part] >= 0).any():
                chosen[location * _CODES + _FIRST] = int(part[0])
    # Code -1 means no phase; it also sorts before the phases of its location.
    keys = sorted(chosen)
    return np.array(keys, np.int64), np.array([chosen[key] for key in keys], np.int64)


def _require_one_press(location: Array, indenter: Array, target: Array) -> None:
    order = np.argsort(location, kind="stable")
    location, indenter, target = location[order], indenter[order], target[order]
    torn = (np.diff(location) == 0) & ((np.diff(indenter) != 0) | (np.diff(target) != 0))
    if torn.any():
        row = int(np.flatnonzero(torn)[0])
        raise SessionError(
            f"location {location[row]}: belongs to target {target[row]} of indenter "
            f"{indenter[row]} and to target {target[row + 1]} of indenter {indenter[row + 1]}; "
            "expected one press"
        )
