"""Frames of the two fingers of a hand that squeeze one object, and its weight along the grip axis.

On an object at rest the normal forces balance: N of the right finger less N of the left one is
mass x g x the component of gravity's unit vector along the grip axis, which points to the right.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from learning.data.matching import SensorSelection
from learning.errors import LearningError
from recorder.archive import ArchivedSensor

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

GRAVITY = 9.80665
# Longest time from a frame of one finger to that of the other [ns].
TOGETHER_NS = 20_000_000
# Attribute of a sensor that names its finger, and the sign of the weight on it.
FINGER, SIGNS = "finger", {"left": -1.0, "right": 1.0}
# Keys in the provenance of a frame, beside its session and run. Frames are learned from that are
# `still`, and `lifted` off what would carry the object, or at step 0, without contact.
KEYS = ("mass", "turn", "step", "still", "lifted")


@dataclass(frozen=True, slots=True, eq=False)
class Squeezes:
    """Frames of both fingers at the same times, while all stands still; n pairs."""

    rows: Integers
    """Rows of the sensor's table (n,)."""
    others: Integers
    """Rows of the other finger's table (n,)."""
    weight: Floats
    """Normal force on the sensor less that on the other finger (n,) [N]."""
    step: Integers
    """Step of the squeeze (n,); 0: without contact."""
    squeeze: Integers
    """Number of the squeeze of each (n,)."""
    indenter: Integers
    """Code of the object in the sensor's archive (n,)."""

    @property
    def held(self) -> NDArray[np.bool_]:
        """True where both fingers touch the object (n,)."""
        return self.step > 0

    def only(self, chosen: NDArray[np.bool_]) -> Self:
        """Return some of the pairs (n,)."""
        return replace(
            self, **{each.name: getattr(self, each.name)[chosen] for each in fields(self)}
        )


def squeezes(sensor: SensorSelection, other: SensorSelection) -> Squeezes:
    """Return the pairs of frames of two fingers, by session, run and time.

    Raises:
        LearningError: They are not the fingers of one hand, or no frames pair.
    """
    sign = _sign(sensor, other)
    mine, its = _still_rows(sensor.archived), _still_rows(other.archived)
    rows, others, known = [], [], []
    for key in mine.keys() & its.keys():
        (own, of), (away, _) = mine[key], its[key]
        t_own, t_away = sensor.archived.table["t_ns"][own], other.archived.table["t_ns"][away]
        nearest = _nearest(t_own, t_away)
        near = np.abs(t_away[nearest] - t_own) <= TOGETHER_NS
        rows.append(own[near])
        others.append(away[nearest][near])
        known.append(of[near])
    if not sum(map(len, rows)):
        raise LearningError(
            f"--source: found no frames of {other.sensor} within {TOGETHER_NS // 1_000_000} ms of "
            f"still ones of {sensor.sensor}; allowed: both fingers of the same sessions"
        )
    row, away, facts = np.concatenate(rows), np.concatenate(others), np.concatenate(known)
    order = np.argsort(row)
    row, away, facts = row[order], away[order], facts[order]
    names = np.array(sensor.archive.indenters)[sensor.archived.table["indenter"][row]]
    its_names = np.array(other.archive.indenters)[other.archived.table["indenter"][away]]
    if (wrong := np.flatnonzero(names != its_names)).size:
        raise LearningError(
            f"row {row[wrong[0]]}: found {names[wrong[0]]} on {sensor.sensor} and "
            f"{its_names[wrong[0]]} on {other.sensor} at one time; allowed: one object"
        )
    step = facts[:, 2].astype(np.int64)
    return Squeezes(
        rows=row,
        others=away,
        weight=np.where(step > 0, sign * GRAVITY * facts[:, 0] * facts[:, 1], 0.0),
        step=step,
        squeeze=sensor.archived.table["location"][row].astype(np.int64),
        indenter=sensor.archived.table["indenter"][row].astype(np.int64),
    )


def _sign(sensor: SensorSelection, other: SensorSelection) -> float:
    """Return 1 if the sensor is the right finger, -1 if it is the left one."""
    fingers = [each.archived.attrs.get(FINGER) for each in (sensor, other)]
    if sorted(map(str, fingers)) != sorted(SIGNS):
        raise LearningError(
            f"{sensor.sensor}, {other.sensor}: found fingers {fingers[0]}, {fingers[1]}; allowed: "
            "left and right, archives of a bench with two fingers"
        )
    return SIGNS[str(fingers[0])]


def _still_rows(sensor: ArchivedSensor) -> dict[tuple[str, int], tuple[Integers, Floats]]:
    """Return rows by time (n,), and mass, turn along x and step (n, 3), by session and run."""
    table, facts = sensor.table, [_facts(line, sensor.name) for line in sensor.sources]
    by_run: dict[tuple[str, int], list[int]] = {}
    usable = table["valid"] & (table["location"] >= 0)
    for row in np.flatnonzero(usable)[np.argsort(table["t_ns"][usable], kind="stable")].tolist():
        key, values = facts[table["source"][row]]
        if values is not None:
            by_run.setdefault(key, []).append(row)
    return {
        key: (np.array(rows), np.array([facts[table["source"][row]][1] for row in rows]))
        for key, rows in by_run.items()
    }


def _facts(line: str, name: str) -> tuple[tuple[str, int], tuple[float, float, float] | None]:
    """Return session and run of a provenance line, and mass, turn along x and step if usable."""
    try:
        source: Mapping[str, Any] = json.loads(line)
        mass, turn, step, still, lifted = (source[key] for key in KEYS)
        key = str(source["session"]), int(source["run"])
        values = float(mass), float(turn[0]), float(step)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise LearningError(
            f"{name}: found the source {line[:60]!r} ({error!r}); allowed: frames of squeezes, "
            f"whose sources have {', '.join(KEYS)}"
        ) from None
    if not (np.isfinite(values).all() and values[0] >= 0 and abs(values[1]) <= 1 + 1e-6):
        raise LearningError(
            f"{name}: found mass {mass} kg and turn {turn}; allowed: 0 kg or more, a unit vector"
        )
    return key, values if still and (lifted or not step) else None


def _nearest(times: NDArray[np.int64], others: NDArray[np.int64]) -> Integers:
    """Return the index of the nearest of some increasing times (m,) to each time (n,)."""
    after = np.clip(np.searchsorted(others, times), 1, max(len(others) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(others) - 1)
    closer = np.abs(others[after] - times) < np.abs(others[before] - times)
    return np.where(closer, after, before)
