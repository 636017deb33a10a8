"""Frames of the two fingers of a hand that squeeze one object, and its weight along the grip axis.

On an object at rest the normal forces balance: N of the right finger less N of the left one is
mass x g x the component of gravity's unit vector along the grip axis, which points to the right.
"""

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from learning.data.matching import SensorSelection
from learning.errors import LearningError

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Longest time from a frame of one finger to that of the other [ns].
GRAVITY, TOGETHER_NS = 9.80665, 20_000_000
# Sign of the weight on a finger, by the attribute of its sensor.
SIGNS = {"left": -1.0, "right": 1.0}
# Keys in the provenance of a frame, beside its session and run: mass that the fingers bear. Frames
# are learned from that are `still` at step 0, without contact, or while nothing else bears a part.
KEYS = ("mass", "turn", "step", "still")


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
    """Step of the squeeze (n,); 0: without contact; else the fingers alone bear the object."""
    indenter: Integers
    """Code of the object in the sensor's archive (n,)."""


def squeezes(
    sensor: SensorSelection, other: SensorSelection, unseen: tuple[str, ...] | None = None
) -> Squeezes:
    """Return the pairs of frames of two fingers, by session, run and time.

    Objects `unseen` are left out; None: those on which models may not be trained.

    Raises:
        LearningError: They are not the fingers of one hand, or no frames pair.
    """
    fingers = [str(each.archived.attrs.get("finger")) for each in (sensor, other)]
    if sorted(fingers) != sorted(SIGNS):
        raise LearningError(
            f"{sensor.sensor}, {other.sensor}: found fingers {', '.join(fingers)}; allowed: left "
            "and right, archives of a bench with two fingers"
        )
    (mine, step, weight), (its, *_) = (_still(each, unseen) for each in (sensor, other))
    times = [each.archived.table["t_ns"] for each in (sensor, other)]
    keys = [key for key, rows in its.items() if len(rows) and key in mine]
    parts = [_nearest(mine[key], its[key], *times) for key in keys]
    if not sum(part.shape[1] for part in parts):
        raise LearningError(
            f"--source: found no frames of {other.sensor} within {TOGETHER_NS // 1_000_000} ms of "
            f"still ones of {sensor.sensor}; allowed: both fingers of the same sessions"
        )
    pairs = np.concatenate(parts, axis=1)
    rows, others = pairs[:, np.argsort(pairs[0])]
    indenter = sensor.archived.table["indenter"][rows].astype(np.int64)
    return Squeezes(rows, others, SIGNS[fingers[0]] * weight[rows], step[rows], indenter)


def _still(
    of: SensorSelection, unseen: tuple[str, ...] | None
) -> tuple[dict[str, Integers], Integers, Floats]:
    """Return usable rows by session and run, in order of time, and steps and weights of all."""
    sensor, table = of.archived, of.archived.table
    known = [_known(line, sensor.name) for line in sensor.sources]
    name = np.array(of.archive.indenters)[table["indenter"]]
    seen = table["seen"] if unseen is None else ~np.isin(name, unseen)
    source = np.asarray(table["source"], np.int64)
    run, usable, step, weight = (np.array(column) for column in zip(*known, strict=True))
    chosen = usable[source] & seen & table["valid"] & (table["location"] >= 0)
    order = np.argsort(table["t_ns"], kind="stable")
    by_run = {one: order[(chosen & (run[source] == one))[order]] for one in np.unique(run)}
    return by_run, step[source], weight[source]


def _known(line: str, name: str) -> tuple[str, bool, int, float]:
    """Return run of a provenance line, whether it is used, step, and weight along the grip [N]."""
    try:
        source = json.loads(line)
        mass, turn, step, still = (source[key] for key in KEYS)
        run = f"{source['session']} {source['run']}"
        mass, along, step = float(mass), float(turn[0]), int(step)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        allowed = f"frames of squeezes, with {', '.join(KEYS)}"
        raise LearningError(
            f"{name}: found {line[:60]!r} ({error!r}); allowed: {allowed}"
        ) from None
    weight = GRAVITY * mass * along if step else 0.0
    return run, bool(still and (mass or not step)), step, weight


def _nearest(
    rows: Integers, others: Integers, times: NDArray[np.int64], of_others: NDArray[np.int64]
) -> Integers:
    """Return rows and those of the other finger nearest in time (2, n), if near enough."""
    own, its = times[rows], of_others[others]
    after = np.clip(np.searchsorted(its, own), 0, len(its) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(its[after] - own) < np.abs(its[before] - own), after, before)
    near = np.abs(its[nearest] - own) <= TOGETHER_NS
    return np.stack([rows[near], others[nearest[near]]])
