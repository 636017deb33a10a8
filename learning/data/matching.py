"""Presses of several sensors that match, and reasons why others do not.

Presses of two sensors match if the same indenter touched at the same place, to the same fraction of
the sensor's deepest press, in the same shear direction. Their numbers do not count: another plan,
or another order of points, numbers them differently. Place, depth and direction are read from the
frames, at the ends of the phases; frames of matching presses are then paired phase by phase.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from recorder import MarkerArchive
from recorder.archive import NO_PHASE, ArchivedSensor, location_pairs, press_rows
from recorder.spec import PHASES

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

NORMAL, SHEAR = PHASES.index("normal_inc"), PHASES.index("shear_inc")
# Columns of a table, beside the location, that pair frames.
_PAIRING = ("target", "indenter", "phase", "frame", "valid")
# Presses that are compared with all others at once.
_BLOCK = 512
# Rounding of sums and differences of lengths and angles, allowed beyond a tolerance.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Largest differences of two presses that match."""

    place: float = 1e-4
    """Distance of their places [m]."""
    depth_fraction: float = 0.04
    """Difference of their depths, each divided by the deepest press of its sensor."""
    angle: float = math.radians(3.0)
    """Angle between their shear directions [rad]."""

    def __post_init__(self) -> None:
        for name, most in (("place", 1.0), ("depth_fraction", 1.0), ("angle", math.pi)):
            value = getattr(self, name)
            if not 0 < value < most:
                raise LearningError(f"{name}: found {value!r}; allowed: above 0, below {most:g}")

    def __str__(self) -> str:
        return (
            f"{1e3 * self.place:g} mm, {self.depth_fraction:g} of the depth, "
            f"{math.degrees(self.angle):g} deg"
        )


@dataclass(frozen=True, slots=True)
class SensorSelection:
    """One sensor of an archive, and its name in the joined one."""

    archive: MarkerArchive
    sensor: str
    name: str

    @property
    def archived(self) -> ArchivedSensor:
        """The sensor in its archive."""
        return self.archive[self.sensor]


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPresses:
    """The presses of a sensor that have a location, in the order of their targets."""

    of: SensorSelection
    indenter: NDArray[np.str_]
    """Name of the indenter of each (p,)."""
    target: Integers
    """Number in its archive (p,)."""
    location: Integers
    """Location in its archive (p,)."""
    place: Floats
    """Place before the shear (p, 2) [m]; NaN if no frame has it."""
    depth: Floats
    """Largest depth (p,) [m]."""
    fraction: Floats
    """The same over the deepest of the sensor (p,)."""
    angle: Floats
    """Shear direction, counter-clockwise from +x (p,) [rad]; NaN for a press without shear."""
    flaw: NDArray[np.str_]
    """Reason why a press has no place or direction (p,), or an empty text."""

    def __len__(self) -> int:
        return len(self.location)

    def subset(self, rows: NDArray[Any]) -> Self:
        """Return some of the presses."""
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return replace(self, **{name: each[rows] for name, each in values.items() if name != "of"})

    def describe(self, row: int) -> str:
        """Return number, place, depth and direction of a press as text."""
        x, y = 1e3 * self.place[row]
        angle = self.angle[row]
        turned = "no shear" if np.isnan(angle) else f"{math.degrees(angle) % 360:.1f} deg"
        return (
            f"target {self.target[row]} of {self.indenter[row]} ({x:+.2f}, {y:+.2f} mm, "
            f"{1e3 * self.depth[row]:.3f} mm deep, {turned})"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Differences:
    """Differences between some presses and others (p, q)."""

    indenter: NDArray[np.bool_]
    """True where the indenter is another."""
    place: Floats
    fraction: Floats
    angle: Floats
    """Infinite where only one of both has a direction."""

    @classmethod
    def of(cls, one: PlacedPresses, other: PlacedPresses) -> Self:
        """Compare each press of `one` with each of `other`."""
        distance = np.linalg.norm(one.place[:, None] - other.place[None], axis=-1)
        angle = _turn(one.angle[:, None], other.angle[None])
        without, others = np.isnan(one.angle)[:, None], np.isnan(other.angle)[None]
        angle = np.where(without & others, 0.0, np.where(without | others, np.inf, angle))
        return cls(
            one.indenter[:, None] != other.indenter[None],
            np.where(np.isnan(distance), np.inf, distance),
            np.abs(one.fraction[:, None] - other.fraction[None]),
            angle,
        )

    def alike(self, tolerances: Tolerances) -> tuple[NDArray[np.bool_], ...]:
        """Return where presses (p, q) agree: in indenter; and place; and depth; and direction."""
        same = ~self.indenter
        here = same & (self.place <= tolerances.place + _ROUNDING)
        deep = here & (self.fraction <= tolerances.depth_fraction + _ROUNDING)
        return same, here, deep, deep & (self.angle <= tolerances.angle + _ROUNDING)


def _turn(one: Floats, other: Floats) -> Floats:
    """Return the angle between directions, 0 to pi [rad]."""
    return np.asarray(np.abs((one - other + math.pi) % (2 * math.pi) - math.pi))


def read_presses(chosen: SensorSelection) -> PlacedPresses:
    """Read where, how deep and in which direction a sensor was pressed."""
    sensor = chosen.archived
    prefix = f"{chosen.archive.name}: {chosen.sensor}"
    for key in ("position", "depth"):
        stated = str(sensor.attrs.get(key, ""))
        if stated.startswith("unknown"):
            raise LearningError(
                f"{prefix}: {key} is {stated!r}, so its presses cannot be matched to others; "
                "allowed: import it with its plan or turn (tactile import --plan, --turn), or "
                "train a model of its own, which needs no join"
            )
    table = sensor.table
    numbers, at = np.unique(np.asarray(table["location"], np.int64), return_index=True)
    locations, rows = numbers[numbers >= 0], at[numbers >= 0]
    if not len(locations):
        raise LearningError(f"{prefix}: no press has a location; allowed: presses with shear")
    ends: dict[int, dict[int, int]] = {}
    for (location, phase), part in press_rows(table, "phase").items():
        ends.setdefault(location, {})[phase] = int(part[-1])
    deepest_of = {
        location: table["depth"][part].max() for (location,), part in press_rows(table).items()
    }
    count = len(locations)
    position = np.full((count, 2), np.nan)
    depth, angle = np.full((2, count), np.nan)
    flaw = np.full(count, "", "<U64")
    for index, location in enumerate(locations.tolist()):
        phases = ends.get(location, {})
        still = phases.get(NO_PHASE if NO_PHASE in phases else NORMAL)
        if still is None:
            flaw[index] = f"no frame of {PHASES[NORMAL]}" if phases else "no frame that is there"
            continue
        # The last frame of a phase may be taken before its end: the depth is reached by then or
        # in the shear, which keeps it.
        position[index], depth[index] = table["position"][still], deepest_of[location]
        if NO_PHASE in phases:
            continue
        if SHEAR not in phases:
            flaw[index] = f"no frame of {PHASES[SHEAR]}, so its direction is unknown"
            position[index] = np.nan
            continue
        x, y = np.asarray(table["position"][phases[SHEAR]]) - position[index]
        angle[index] = math.atan2(y, x)
        if not (x or y):
            flaw[index] = "its shear has no length, so its direction is unknown"
            position[index] = np.nan
    deepest = np.nanmax(depth) if np.isfinite(depth).any() else 0.0
    if not deepest > 0:
        raise LearningError(f"{prefix}: no press is deeper than 0 mm; allowed: known depths")
    names = np.array(chosen.archive.indenters)
    return PlacedPresses(
        of=chosen,
        indenter=names[table["indenter"][rows]],
        target=table["target"][rows].astype(np.int64),
        location=locations,
        place=position,
        depth=depth,
        fraction=depth / deepest,
        angle=angle,
        flaw=flaw,
    )


# Matching: every press is given the number of a place, equal for those that matched.


def match(sensors: Sequence[PlacedPresses], tolerances: Tolerances) -> list[Integers]:
    """Return the number of the place of each press of each sensor, equal where presses matched."""
    numbered: list[Integers] = []
    matched: list[tuple[PlacedPresses, Integers]] = []
    count = 0
    for presses in sensors:
        _require_apart(presses, tolerances)
        number = np.full(len(presses), -1, np.int64)
        for others, numbers in matched:
            for rows in _blocks(presses):
                near = Differences.of(presses.subset(rows), others).alike(tolerances)[-1]
                for row, column in np.argwhere(near).tolist():
                    press, at = int(rows[row]), int(numbers[column])
                    if number[press] not in (-1, at):
                        raise _ambiguous(presses, press, others, column, tolerances)
                    number[press] = at
        _require_one_each(presses, number, tolerances)
        for others, numbers in matched:
            _require_all_near(presses, number, others, numbers, tolerances)
        new = np.flatnonzero(number < 0)
        number[new] = count + np.arange(len(new))
        count += len(new)
        matched.append((presses, number))
        numbered.append(number)
    return numbered


def _blocks(presses: PlacedPresses) -> Iterator[Integers]:
    for first in range(0, len(presses), _BLOCK):
        yield np.arange(first, min(first + _BLOCK, len(presses)), dtype=np.int64)


def _require_apart(presses: PlacedPresses, tolerances: Tolerances) -> None:
    """Reject a sensor that was pressed twice at one place within the tolerances."""
    for rows in _blocks(presses):
        near = Differences.of(presses.subset(rows), presses).alike(tolerances)[-1]
        near &= np.arange(len(presses))[None] > rows[:, None]
        for row, other in np.argwhere(near)[:1].tolist():
            raise _ambiguous(presses, int(rows[row]), presses, other, tolerances)


def _require_one_each(presses: PlacedPresses, number: Integers, tolerances: Tolerances) -> None:
    order = np.argsort(number, kind="stable")
    twice = np.flatnonzero((np.diff(number[order]) == 0) & (number[order][1:] >= 0))
    if twice.size:
        one, other = int(order[twice[0]]), int(order[twice[0] + 1])
        raise _ambiguous(presses, one, presses, other, tolerances)


def _require_all_near(
    presses: PlacedPresses,
    number: Integers,
    others: PlacedPresses,
    numbers: Integers,
    tolerances: Tolerances,
) -> None:
    """Reject presses that are one place only by way of a third, which matches both."""
    _, rows, columns = np.intersect1d(number, numbers, assume_unique=True, return_indices=True)
    rows, columns = rows[number[rows] >= 0], columns[number[rows] >= 0]
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        one, other = presses.subset(np.array([row])), others.subset(np.array([column]))
        if not Differences.of(one, other).alike(tolerances)[-1].all():
            raise _ambiguous(presses, row, others, column, tolerances)


def _ambiguous(
    one: PlacedPresses, row: int, other: PlacedPresses, column: int, tolerances: Tolerances
) -> LearningError:
    counterpart = "itself" if one is other else other.of.name
    return LearningError(
        f"{one.of.name}: which of its presses match those of {counterpart} is ambiguous within "
        f"{tolerances}: {one.describe(row)}, and {other.describe(column)} of {other.of.name}; "
        "allowed: tighter tolerances, or an archive without one of them"
    )


# Report of the presses that match, and of the others.


@dataclass(frozen=True, slots=True)
class MatchReport:
    """Presses of two sensors that matched, and reasons of the others."""

    one: str
    other: str
    presses: tuple[int, int]
    """Presses of each."""
    matched: int
    frames: int
    """Pairs of frames: of the last ones of the phases that both have."""
    place: float
    """Largest distance of the places of a pair [m]."""
    depth_fraction: float
    """Largest difference of the fractions of depth."""
    angle: float
    """Largest angle between the directions [rad]."""
    unmatched: Mapping[str, int]
    """Number of presses of both that matched none of the other, by reason."""

    def lines(self) -> Iterator[str]:
        """Yield the table's lines for the two sensors."""
        text = (
            f"{self.one} and {self.other}: {self.matched:,} presses matched, of "
            f"{self.presses[0]:,} and {self.presses[1]:,}; {self.frames:,} pairs of frames"
        )
        if self.matched:
            text += (
                f"; at most {1e3 * self.place:.3f} mm, {self.depth_fraction:.3f} of the depth and "
                f"{math.degrees(self.angle):.2f} deg apart"
            )
        yield text
        yield from (f"  {count:,} unmatched: {why}" for why, count in self.unmatched.items())


def compare(
    one: PlacedPresses,
    other: PlacedPresses,
    numbers: tuple[Integers, Integers],
    tolerances: Tolerances,
) -> MatchReport:
    """Compare two sensors whose presses have the numbers that `match` returned."""
    _, rows, columns = np.intersect1d(*numbers, assume_unique=True, return_indices=True)
    mine, its = one.subset(rows), other.subset(columns)
    unmatched: dict[str, int] = {}
    for presses, others, matched in ((one, other, rows), (other, one, columns)):
        rest = presses.subset(np.setdiff1d(np.arange(len(presses)), matched))
        for why in _reasons(rest, others, tolerances):
            unmatched[why] = unmatched.get(why, 0) + 1
    return MatchReport(
        one=one.of.name,
        other=other.of.name,
        presses=(len(one), len(other)),
        matched=len(rows),
        frames=len(location_pairs(_paired(one, numbers[0]), _paired(other, numbers[1]))),
        place=float(np.linalg.norm(mine.place - its.place, axis=1).max(initial=0.0)),
        depth_fraction=float(np.abs(mine.fraction - its.fraction).max(initial=0.0)),
        angle=float(np.nan_to_num(_turn(mine.angle, its.angle)).max(initial=0.0)),
        unmatched=dict(sorted(unmatched.items())),
    )


def _paired(presses: PlacedPresses, number: Integers) -> dict[str, NDArray[Any]]:
    """Return the columns of a sensor's table that pair frames, with numbers as locations."""
    table = presses.of.archived.table
    location = mapped(table["location"], presses.location, number)
    return {name: table[name] for name in _PAIRING} | {"location": location}


def mapped(values: NDArray[Any], old: Integers, new: Integers) -> Integers:
    """Replace the values `old` (ascending) by `new`; those below 0 stay."""
    values = np.asarray(values, np.int64)
    index = np.minimum(np.searchsorted(old, values), len(old) - 1)
    return np.where(values < 0, values, new[index])


def _reasons(
    presses: PlacedPresses, others: PlacedPresses, tolerances: Tolerances
) -> Iterator[str]:
    """Yield why each press of one sensor matches none of another: the first difference."""
    who = f"{presses.of.name}, {{}}"
    for rows in _blocks(presses):
        some = presses.subset(rows)
        apart = Differences.of(some, others)
        same, here, deep, _ = apart.alike(tolerances)
        for row in range(len(some)):
            if some.flaw[row]:
                why = str(some.flaw[row])
            elif not same[row].any():
                why = f"{others.of.name} has no press of {some.indenter[row]}"
            elif not here[row].any():
                nearest = 1e3 * apart.place[row][same[row]].min()
                why = f"none of {others.of.name} at that place, the nearest {nearest:.2f} mm away"
            elif not deep[row].any():
                why = f"none of {others.of.name} there at that fraction of the depth, "
                why += f"{some.fraction[row]:.2f}"
            else:
                nearest = math.degrees(apart.angle[row][deep[row]].min())
                why = f"none of {others.of.name} there in that direction, the nearest "
                why += f"{nearest:.1f} deg away" if math.isfinite(nearest) else "has none"
            yield who.format(why)
