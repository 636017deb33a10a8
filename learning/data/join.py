"""Joining of archives by place: `tactile archive join`.

Presses of two sensors meet if the same indenter touched at the same place, to the same fraction of
the sensor's deepest press, in the same shear direction. Their numbers do not count: another plan,
or another order of points, numbers them otherwise. Place, depth and direction are read from the
frames, at the ends of the phases; frames of presses that met are then paired phase by phase.

A joined archive is a copy. Presses that met share a location; those that met none keep one of
their own. The presses of an indenter are numbered again, equally in all sensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.archive_writer import Frames, archive_fingerprint, fill_archive
from learning.errors import LearningError
from learning.indenters import coded
from recorder import MarkerArchive
from recorder.archive import (
    GIVEN,
    NO_PHASE,
    ArchivedSensor,
    MarkerCount,
    SensorPlan,
    location_pairs,
)
from recorder.spec import PHASES

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

NORMAL, SHEAR = PHASES.index("normal_inc"), PHASES.index("shear_inc")
# Attributes of an archive and of a sensor that the format sets itself.
_OF_ARCHIVE = ("format", "format_version", "status", "sensors", "indenters")
_OF_SENSOR = ("mm_per_px", "marker_check", "displacement_of")
# Presses that are compared with all others at once.
_BLOCK = 512
# Rounding of sums and differences of lengths and angles, allowed beyond a tolerance.
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Tolerances:
    """Largest differences of two presses that meet.

    Raises:
        LearningError: A value is not above 0, or so large that it excludes nothing.
    """

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
class Chosen:
    """One sensor of an archive, and its name in the joined one."""

    archive: MarkerArchive
    sensor: str
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class Presses:
    """The presses of a sensor that have a location, in the order of their targets."""

    of: Chosen
    indenter: NDArray[np.str_]
    """Name of the indenter of each (p,)."""
    target: Integers
    """Number in its archive (p,)."""
    location: Integers
    """Location in its archive (p,)."""
    place: Floats
    """Place before the shear (p, 2) [m]; NaN if no frame tells it."""
    depth: Floats
    """Largest depth (p,) [m]."""
    fraction: Floats
    """The same over the deepest of the sensor (p,)."""
    angle: Floats
    """Shear direction, counter-clockwise from +x (p,) [rad]; NaN for a press without shear."""
    flaw: NDArray[np.str_]
    """Reason why a press has no place or direction (p,), or an empty text."""

    def __len__(self) -> int:
        """Return the number of presses."""
        return len(self.location)

    def subset(self, rows: NDArray[Any]) -> Presses:
        """Return some of the presses."""
        names = ("indenter", "target", "location", "place", "depth", "fraction", "angle", "flaw")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

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

    def meet(self, tolerances: Tolerances) -> NDArray[np.bool_]:
        """Return True where presses meet (p, q)."""
        near = ~self.indenter & (self.place <= tolerances.place + _ROUNDING)
        near &= self.fraction <= tolerances.depth_fraction + _ROUNDING
        return np.asarray(near & (self.angle <= tolerances.angle + _ROUNDING))


def differences(one: Presses, other: Presses) -> Differences:
    """Compare each press of `one` with each of `other`."""
    place = np.linalg.norm(one.place[:, None] - other.place[None], axis=-1)
    turn = one.angle[:, None] - other.angle[None]
    angle = np.abs((turn + math.pi) % (2 * math.pi) - math.pi)
    without = np.isnan(one.angle)[:, None], np.isnan(other.angle)[None]
    angle = np.where(without[0] & without[1], 0.0, np.where(without[0] | without[1], np.inf, angle))
    return Differences(
        one.indenter[:, None] != other.indenter[None],
        np.where(np.isnan(place), np.inf, place),
        np.abs(one.fraction[:, None] - other.fraction[None]),
        angle,
    )


def read_presses(chosen: Chosen) -> Presses:
    """Read where, how deep and in which direction a sensor was pressed.

    Raises:
        LearningError: Places or depths are unknown, or no press has a location.
        SessionError: The archive is incomplete or corrupt.
    """
    sensor = chosen.archive[chosen.sensor]
    where = f"{chosen.archive.name}: {chosen.sensor}"
    for key in ("position", "depth"):
        told = str(sensor.attrs.get(key, ""))
        if told.startswith("unknown"):
            raise LearningError(
                f"{where}: {key} is {told!r}, so nothing tells which of its presses meet others; "
                "allowed: import it with its plan (import-genforce --plan), or train a model of "
                "its own, which needs no join"
            )
    table = sensor.table
    ends, deepest_of = _ends(table), _deepest(table)
    locations = np.unique(np.asarray(table["location"], np.int64)[table["location"] >= 0])
    if not len(locations):
        raise LearningError(f"{where}: no press has a location; allowed: presses with shear")
    first = {int(at): row for at, row in zip(*_first(table), strict=True)}
    count = len(locations)
    place, depth, angle = (
        np.full((count, 2), np.nan),
        np.full(count, np.nan),
        np.full(count, np.nan),
    )
    flaw = np.full(count, "", "<U64")
    for index, location in enumerate(locations.tolist()):
        phases = ends.get(location, {})
        still = phases.get(NO_PHASE if NO_PHASE in phases else NORMAL)
        if still is None:
            flaw[index] = f"no frame of {PHASES[NORMAL]}" if phases else "no frame that is there"
            continue
        # The last frame of a phase may be taken before its end: the depth is reached by then or
        # in the shear, which keeps it.
        place[index], depth[index] = table["position"][still], deepest_of[location]
        if NO_PHASE in phases:
            continue
        if SHEAR not in phases:
            flaw[index] = f"no frame of {PHASES[SHEAR]}, so its direction is unknown"
            place[index] = np.nan
            continue
        x, y = np.asarray(table["position"][phases[SHEAR]]) - place[index]
        angle[index] = math.atan2(y, x)
        if not (x or y):
            flaw[index] = "its shear has no length, so its direction is unknown"
            place[index] = np.nan
    deepest = np.nanmax(depth) if np.isfinite(depth).any() else 0.0
    if not deepest > 0:
        raise LearningError(f"{where}: no press is deeper than 0 mm; allowed: known depths")
    rows = np.array([first[location] for location in locations.tolist()])
    names = np.array(chosen.archive.indenters)
    return Presses(
        of=chosen,
        indenter=names[table["indenter"][rows]],
        target=table["target"][rows].astype(np.int64),
        location=locations,
        place=place,
        depth=depth,
        fraction=depth / deepest,
        angle=angle,
        flaw=flaw,
    )


def _ends(table: Mapping[str, NDArray[Any]]) -> dict[int, dict[int, int]]:
    """Return the row of the last valid frame of each phase, by location and phase."""
    rows = np.flatnonzero((table["location"] >= 0) & table["valid"])
    order = rows[np.lexsort((table["frame"][rows], table["phase"][rows], table["location"][rows]))]
    keys = np.stack([table["location"][order], table["phase"][order]], axis=1)
    last = np.append((np.diff(keys, axis=0) != 0).any(axis=1), True)[: len(order)]
    found: dict[int, dict[int, int]] = {}
    for (location, phase), row in zip(keys[last].tolist(), order[last].tolist(), strict=True):
        found.setdefault(location, {})[phase] = row
    return found


def _deepest(table: Mapping[str, NDArray[Any]]) -> dict[int, float]:
    """Return the largest depth of the valid frames of each location [m]."""
    rows = np.flatnonzero((table["location"] >= 0) & table["valid"])
    locations, which = np.unique(table["location"][rows], return_inverse=True)
    depth = np.full(len(locations), -np.inf)
    np.maximum.at(depth, which.reshape(-1), table["depth"][rows])
    return dict(zip(locations.tolist(), depth.tolist(), strict=True))


def _first(table: Mapping[str, NDArray[Any]]) -> tuple[list[int], list[int]]:
    """Return the locations, and a row of each."""
    locations, rows = np.unique(table["location"], return_index=True)
    return locations.tolist(), rows.tolist()


# Meeting: every press is given the number of a place, equal for those that met.


def meet(sensors: Sequence[Presses], tolerances: Tolerances) -> list[Integers]:
    """Return the number of the place of each press of each sensor, equal where presses met.

    Raises:
        LearningError: Which presses meet is ambiguous; they are named.
    """
    found: list[Integers] = []
    known: list[tuple[Presses, Integers]] = []
    count = 0
    for presses in sensors:
        _require_apart(presses, tolerances)
        number = np.full(len(presses), -1, np.int64)
        for others, numbers in known:
            for rows in _blocks(presses):
                near = differences(presses.subset(rows), others).meet(tolerances)
                for row, column in np.argwhere(near).tolist():
                    press, at = int(rows[row]), int(numbers[column])
                    if number[press] not in (-1, at):
                        raise _ambiguous(presses, press, others, column, tolerances)
                    number[press] = at
        _require_one_each(presses, number, tolerances)
        for others, numbers in known:
            _require_all_near(presses, number, others, numbers, tolerances)
        new = np.flatnonzero(number < 0)
        number[new] = count + np.arange(len(new))
        count += len(new)
        known.append((presses, number))
        found.append(number)
    return found


def _blocks(presses: Presses) -> Iterator[Integers]:
    for first in range(0, len(presses), _BLOCK):
        yield np.arange(first, min(first + _BLOCK, len(presses)), dtype=np.int64)


def _require_apart(presses: Presses, tolerances: Tolerances) -> None:
    """Reject a sensor that was pressed twice at what the tolerances call one place."""
    for rows in _blocks(presses):
        near = differences(presses.subset(rows), presses).meet(tolerances)
        near &= np.arange(len(presses))[None] > rows[:, None]
        for row, other in np.argwhere(near)[:1].tolist():
            raise _ambiguous(presses, int(rows[row]), presses, other, tolerances)


def _require_one_each(presses: Presses, number: Integers, tolerances: Tolerances) -> None:
    order = np.argsort(number, kind="stable")
    twice = np.flatnonzero((np.diff(number[order]) == 0) & (number[order][1:] >= 0))
    if twice.size:
        one, other = int(order[twice[0]]), int(order[twice[0] + 1])
        raise _ambiguous(presses, one, presses, other, tolerances)


def _require_all_near(
    presses: Presses, number: Integers, others: Presses, numbers: Integers, tolerances: Tolerances
) -> None:
    """Reject presses that are one place only by way of a third, which meets both."""
    _, rows, columns = np.intersect1d(number, numbers, assume_unique=True, return_indices=True)
    rows, columns = rows[number[rows] >= 0], columns[number[rows] >= 0]
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        one, other = presses.subset(np.array([row])), others.subset(np.array([column]))
        if not differences(one, other).meet(tolerances).all():
            raise _ambiguous(presses, row, others, column, tolerances)


def _ambiguous(
    one: Presses, row: int, other: Presses, column: int, tolerances: Tolerances
) -> LearningError:
    counterpart = "itself" if one is other else other.of.name
    return LearningError(
        f"{one.of.name}: which of its presses meet those of {counterpart} is ambiguous within "
        f"{tolerances}: {one.describe(row)}, and {other.describe(column)} of {other.of.name}; "
        "allowed: tighter tolerances, or an archive without one of them"
    )


# Report of what met.


@dataclass(frozen=True, slots=True)
class Pair:
    """Presses of two sensors that met, and reasons of the others."""

    one: str
    other: str
    presses: tuple[int, int]
    """Presses of each."""
    met: int
    """Presses that met."""
    frames: int
    """Pairs of frames: of the last ones of the phases that both have."""
    place: float
    """Largest distance of the places of a pair [m]."""
    depth_fraction: float
    """Largest difference of the fractions of depth."""
    angle: float
    """Largest angle between the directions [rad]."""
    unmet: Mapping[str, int]
    """Number of presses of both that met none of the other, by reason."""

    def lines(self) -> Iterator[str]:
        """Yield the table's lines for the two sensors."""
        text = (
            f"{self.one} and {self.other}: {self.met:,} presses met, of {self.presses[0]:,} and "
            f"{self.presses[1]:,}; {self.frames:,} pairs of frames"
        )
        if self.met:
            text += (
                f"; at most {1e3 * self.place:.3f} mm, {self.depth_fraction:.3f} of the depth and "
                f"{math.degrees(self.angle):.2f} deg apart"
            )
        yield text
        yield from (f"  {count:,} did not: {why}" for why, count in self.unmet.items())


def compare(
    one: Presses, other: Presses, numbers: tuple[Integers, Integers], tolerances: Tolerances
) -> Pair:
    """Compare two sensors whose presses have the numbers that `meet` returned."""
    _, rows, columns = np.intersect1d(*numbers, assume_unique=True, return_indices=True)
    mine, its = one.subset(rows), other.subset(columns)
    turn = mine.angle - its.angle
    angle = np.abs((turn + math.pi) % (2 * math.pi) - math.pi)
    unmet: dict[str, int] = {}
    for presses, others, met in ((one, other, rows), (other, one, columns)):
        rest = presses.subset(np.setdiff1d(np.arange(len(presses)), met))
        for why in _reasons(rest, others, tolerances):
            unmet[why] = unmet.get(why, 0) + 1
    source, target = (
        _renumbered(each, number) for each, number in zip((one, other), numbers, strict=True)
    )
    return Pair(
        one=one.of.name,
        other=other.of.name,
        presses=(len(one), len(other)),
        met=len(rows),
        frames=len(location_pairs(source, target)),
        place=float(np.linalg.norm(mine.place - its.place, axis=1).max(initial=0.0)),
        depth_fraction=float(np.abs(mine.fraction - its.fraction).max(initial=0.0)),
        angle=float(np.nan_to_num(angle).max(initial=0.0)),
        unmet=dict(sorted(unmet.items())),
    )


def _renumbered(presses: Presses, number: Integers) -> dict[str, NDArray[Any]]:
    """Return the columns of a sensor's table that pair frames, with numbers as locations."""
    table = presses.of.archive[presses.of.sensor].table
    names = ("target", "indenter", "phase", "frame", "valid")
    return {
        "location": _mapped(table["location"], presses.location, number),
        **{name: table[name] for name in names},
    }


def _mapped(values: NDArray[Any], known: Integers, to: Integers) -> Integers:
    """Replace known values (ascending) by others; those below 0 stay."""
    values = np.asarray(values, np.int64)
    place = np.minimum(np.searchsorted(known, values), len(known) - 1)
    return np.where(values < 0, values, to[place])


def _reasons(presses: Presses, others: Presses, tolerances: Tolerances) -> Iterator[str]:
    """Yield why each press of one sensor met none of another: the first thing that differs."""
    who = f"{presses.of.name}, {{}}"
    for rows in _blocks(presses):
        some = presses.subset(rows)
        apart = differences(some, others)
        same = ~apart.indenter
        here = same & (apart.place <= tolerances.place + _ROUNDING)
        deep = here & (apart.fraction <= tolerances.depth_fraction + _ROUNDING)
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


# The joined archive.


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """Sensors with common locations, ready to be written."""

    sensors: tuple[JoinedSensor, ...]
    indenters: tuple[str, ...]
    """Names, by code."""
    pairs: tuple[Pair, ...]
    """Presses that met, for each two sensors."""
    tolerances: Tolerances

    def lines(self) -> Iterator[str]:
        """Yield the table of presses that met, and of those that did not by reason."""
        yield f"within {self.tolerances}:"
        for pair in self.pairs:
            yield from pair.lines()

    def write(
        self, out: Path, progress: Callable[[int, int], None] = lambda done, total: None
    ) -> int:
        """Write the archive, or continue it; return the number of frames that were copied.

        Raises:
            SessionError: Another archive is at `out`, or a source is corrupt.
            OSError: The disk is full, or not writable.
        """
        sources: dict[str, str] = {}
        for each in self.sensors:
            archive = each.chosen.archive
            if archive.name not in sources:
                sources[archive.name] = archive_fingerprint(archive)
        attrs = {
            "made_from": "archives, joined by place",
            "tolerances": asdict(self.tolerances),
            "met": [asdict(pair) for pair in self.pairs],
            "archives": [
                {"name": Path(name).name, "sha256": digest} for name, digest in sources.items()
            ],
        }
        return fill_archive(out, self.sensors, self.indenters, attrs, progress)


@dataclass(frozen=True, slots=True, eq=False)
class JoinedSensor:
    """A sensor of a joined archive; implements `learning.archive_writer.SensorFrames`."""

    chosen: Chosen
    indenter: Integers
    """Code in the joined archive, by code in its own."""
    location: Integers
    """Location of each row (n,), or -1."""
    target: Integers
    """Target of each row (n,)."""
    unseen: tuple[str, ...] | None
    """Indenters that models may not be trained on; None: as in its archive."""
    fields_of: str | None
    """Name of the joined sensor that stores the displacement fields of this one too."""

    @property
    def sensor(self) -> ArchivedSensor:
        """The sensor in its own archive."""
        return self.chosen.archive[self.chosen.sensor]

    @property
    def _keeps_fields(self) -> bool:
        return self.sensor.fields is not None and self.fields_of is None

    @property
    def plan(self) -> SensorPlan:
        """Plan of its part of the archive."""
        sensor, archive = self.sensor, self.chosen.archive
        spec, check = sensor.markers.layout.spec, sensor.attrs.get("marker_check")
        of_archive = {key: archive.attrs[key] for key in archive.attrs if key not in _OF_ARCHIVE}
        attrs = {key: value for key, value in sensor.attrs.items() if key not in _OF_SENSOR}
        attrs["joined_from"] = {
            "archive": Path(archive.name).name,
            "sensor": self.chosen.sensor,
            "attrs": of_archive,
        }
        return SensorPlan(
            name=self.chosen.name,
            rows=len(sensor),
            chunk_rows=spec.chunk_rows,
            unit_rows=spec.shard_rows,
            references=sensor.references,
            mm_per_px=sensor.mm_per_px,
            lattice=sensor.lattice if self._keeps_fields else None,
            displacement_of=self.fields_of,
            marker_count=None if check is None else MarkerCount(**check),
            attrs=attrs,
        )

    def read(self, rows: slice) -> Frames:
        """Copy some of the frames.

        Raises:
            SessionError: The archive is corrupt.
        """
        sensor = self.sensor
        table = {name: np.asarray(sensor.table[name][rows]) for name in GIVEN}
        table["indenter"] = self.indenter[table["indenter"]]
        table["location"], table["target"] = self.location[rows], self.target[rows]
        if self.unseen is not None:
            names = np.array(self.chosen.archive.indenters)[sensor.table["indenter"][rows]]
            table["seen"] = ~np.isin(names, self.unseen)
        lines = [sensor.sources[one] for one in sensor.table["source"][rows].tolist()]
        fields = sensor.displacement(rows) if self._keeps_fields else None
        return Frames(sensor.packed(rows), table, lines, fields)


def join(
    sensors: Sequence[Chosen],
    tolerances: Tolerances | None = None,
    unseen: tuple[str, ...] | None = None,
) -> Joined:
    """Find which presses of some sensors meet; nothing is written.

    Args:
        sensors: Sensors of any archives, with different names.
        tolerances: Largest differences of presses that meet.
        unseen: Indenters that models may not be trained on; None: as in the archives.

    Raises:
        LearningError: Places are unknown, anything is ambiguous, or nothing meets.
        SessionError: An archive is incomplete or corrupt.
    """
    chosen = tolerances or Tolerances()
    _require_names(sensors)
    _require_seen_alike(sensors, unseen)
    presses = [read_presses(each) for each in sensors]
    numbers = meet(presses, chosen)
    pairs = tuple(
        compare(presses[one], presses[other], (numbers[one], numbers[other]), chosen)
        for one in range(len(presses))
        for other in range(one + 1, len(presses))
    )
    if not any(pair.met for pair in pairs):
        told = "\n".join(line for pair in pairs for line in pair.lines())
        raise LearningError(f"no press met within {chosen}\n{told}")
    indenters = coded(name for each in sensors for name in each.archive.indenters)
    target, location = _numbered(presses, numbers, indenters)
    most = 1 + max((int(some.max()) for some in target), default=0)
    return Joined(
        tuple(
            _joined(each, sensors, indenters, place, number, most, unseen)
            for each, place, number in zip(presses, location, target, strict=True)
        ),
        indenters,
        pairs,
        chosen,
    )


def _require_names(sensors: Sequence[Chosen]) -> None:
    if len(sensors) < 2:
        raise LearningError(f"sensors: found {len(sensors)}; allowed: two or more")
    known: dict[str, Chosen] = {}
    for each in sensors:
        other = known.setdefault(each.name, each)
        if other is not each:
            raise LearningError(
                f"{each.name}: found in {other.archive.name} and in {each.archive.name}; allowed: "
                f"another name for one of both, as in {each.archive.name}:{each.sensor}=NAME"
            )


def _require_seen_alike(sensors: Sequence[Chosen], unseen: tuple[str, ...] | None) -> None:
    """Reject archives that disagree on the indenters that models may be trained on."""
    if unseen is not None:
        return
    known: dict[str, tuple[bool, Chosen]] = {}
    for each in sensors:
        table = each.archive[each.sensor].table
        for code, seen in np.unique(np.stack([table["indenter"], table["seen"]], 1), axis=0):
            name = each.archive.indenters[int(code)]
            before, other = known.setdefault(name, (bool(seen), each))
            if before != bool(seen):
                raise LearningError(
                    f"{name}: models may be trained on it by {(each if seen else other).name}, not "
                    f"by {(other if seen else each).name}; allowed: --unseen, for all sensors"
                )


def _numbered(
    presses: Sequence[Presses], numbers: Sequence[Integers], indenters: tuple[str, ...]
) -> tuple[list[Integers], list[Integers]]:
    """Return target and location of each press of each sensor, from the numbers of its places.

    States of one target, which have a location each, keep a common target.

    Raises:
        LearningError: One target of a sensor met several of another; they are named.
    """
    count = 1 + max(int(number.max()) for number in numbers)
    group = np.arange(count)
    for each, number in zip(presses, numbers, strict=True):
        _merge(group, each, number)
    code = np.zeros(count, np.int64)
    for each, number in zip(presses, numbers, strict=True):
        code[number] = [indenters.index(name) for name in each.indenter]
    target = np.zeros(count, np.int64)
    for one in np.unique(code):
        places = np.flatnonzero(code == one)
        target[places] = np.unique(group[places], return_inverse=True)[1].reshape(-1)
    location = np.empty(count, np.int64)
    location[np.lexsort((np.arange(count), target, code))] = np.arange(count)
    for each, number in zip(presses, numbers, strict=True):
        _require_targets_apart(each, target[number])
    return [target[number] for number in numbers], [location[number] for number in numbers]


def _merge(group: Integers, presses: Presses, number: Integers) -> None:
    """Give all places of one target the lowest group among them."""
    first: dict[tuple[str, int], int] = {}
    for name, target, place in zip(
        presses.indenter.tolist(), presses.target.tolist(), number.tolist(), strict=True
    ):
        one = first.setdefault((name, target), place)
        if group[one] != group[place]:
            low, high = sorted((int(group[one]), int(group[place])))
            group[group == high] = low


def _require_targets_apart(presses: Presses, target: Integers) -> None:
    known: dict[tuple[str, int], int] = {}
    for name, own, new in zip(
        presses.indenter.tolist(), presses.target.tolist(), target.tolist(), strict=True
    ):
        if (other := known.setdefault((name, new), own)) != own:
            raise LearningError(
                f"{presses.of.name}: its targets {other} and {own} of {name} meet different depths "
                "of one target of another sensor; allowed: archives with one target each"
            )


def _joined(
    presses: Presses,
    sensors: Sequence[Chosen],
    indenters: tuple[str, ...],
    location: Integers,
    target: Integers,
    most: int,
    unseen: tuple[str, ...] | None,
) -> JoinedSensor:
    chosen = presses.of
    sensor = chosen.archive[chosen.sensor]
    table = sensor.table
    located = table["location"] >= 0
    of_row = _mapped(table["location"], presses.location, target)
    # Presses without a location are numbered behind all others, each indenter for itself.
    for code in np.unique(table["indenter"][~located]):
        rows = np.flatnonzero(~located & (table["indenter"] == code))
        of_row[rows] = most + np.unique(table["target"][rows], return_inverse=True)[1].reshape(-1)
    owner = sensor.attrs.get("displacement_of")
    named = {
        other.sensor: other.name for other in sensors if other.archive.name == chosen.archive.name
    }
    return JoinedSensor(
        chosen=chosen,
        indenter=np.array([indenters.index(name) for name in chosen.archive.indenters]),
        location=_mapped(table["location"], presses.location, location),
        target=of_row,
        unseen=unseen,
        fields_of=named.get(owner) if owner is not None else None,
    )
