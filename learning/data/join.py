"""Joining of archives by place: `tactile archive join`.

A joined archive is a copy, with the forces of twins that its sensors have. Matching presses share a
location; the others keep one of their own. The presses of an indenter are numbered again, equally
in all sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.data.matching import (
    MatchReport,
    PlacedPresses,
    SensorSelection,
    Tolerances,
    compare,
    mapped,
    match,
    read_presses,
)
from learning.errors import LearningError
from learning.indenters import coded
from recorder.archive import (
    GIVEN,
    ArchivedSensor,
    Frames,
    MarkerCount,
    SensorPlan,
    archive_fingerprint,
    fill_archive,
)

Integers = NDArray[np.int64]

# Attributes of an archive and of a sensor that the format sets itself.
_OF_ARCHIVE = ("format", "format_version", "status", "sensors", "indenters")
_OF_SENSOR = ("mm_per_px", "marker_check", "displacement_of")


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """Sensors with common locations, ready to be written."""

    sensors: tuple[JoinedSensor, ...]
    indenters: tuple[str, ...]
    """Names, by code."""
    pairs: tuple[MatchReport, ...]
    """Presses that matched, for each two sensors."""
    tolerances: Tolerances

    def lines(self) -> Iterator[str]:
        """Yield the table of matched presses, and of unmatched ones by reason."""
        yield f"within {self.tolerances}:"
        for pair in self.pairs:
            yield from pair.lines()

    def write(
        self, out: Path, progress: Callable[[int, int], None] = lambda done, total: None
    ) -> int:
        """Write the archive, or continue it; return the number of frames that were copied."""
        sources: dict[str, str] = {}
        for each in self.sensors:
            archive = each.chosen.archive
            if archive.name not in sources:
                sources[archive.name] = archive_fingerprint(archive)
        attrs = {
            "made_from": "archives, joined by place",
            "tolerances": asdict(self.tolerances),
            "matched": [asdict(pair) for pair in self.pairs],
            "archives": [
                {"name": Path(name).name, "sha256": digest} for name, digest in sources.items()
            ],
        }
        twins = {
            each.chosen.name: forces
            for each in self.sensors
            if (forces := each.sensor.simulated) is not None
        }
        return fill_archive(out, self.sensors, self.indenters, attrs, progress, simulated=twins)


@dataclass(frozen=True, slots=True, eq=False)
class JoinedSensor:
    """A sensor of a joined archive; implements `recorder.archive.SensorFrames`."""

    chosen: SensorSelection
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
    wrench: NDArray[np.float64]
    """Forces and torques of each row (n, 6) [N, N m]; NaN without a label."""

    @property
    def sensor(self) -> ArchivedSensor:
        """The sensor in its own archive."""
        return self.chosen.archived

    @property
    def _keeps_fields(self) -> bool:
        return self.sensor.fields is not None and self.fields_of is None

    @property
    def plan(self) -> SensorPlan:
        """Plan of its part of the archive."""
        sensor, archive = self.sensor, self.chosen.archive
        layout, check = sensor.layout, sensor.attrs.get("marker_check")
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
            chunk_rows=layout.rows_per_chunk,
            unit_rows=layout.rows_per_shard,
            references=sensor.references,
            mm_per_px=sensor.mm_per_px,
            lattice=sensor.lattice if self._keeps_fields else None,
            displacement_of=self.fields_of,
            marker_count=None if check is None else MarkerCount(**check),
            attrs=attrs,
        )

    def read(self, rows: slice) -> Frames:
        """Copy some of the frames."""
        sensor = self.sensor
        table = {name: np.asarray(sensor.table[name][rows]) for name in GIVEN}
        table["indenter"] = self.indenter[table["indenter"]]
        table["location"], table["target"] = self.location[rows], self.target[rows]
        table["wrench"] = self.wrench[rows]
        if self.unseen is not None:
            names = np.array(self.chosen.archive.indenters)[sensor.table["indenter"][rows]]
            table["seen"] = ~np.isin(names, self.unseen)
        lines = sensor.provenance(rows)
        fields = sensor.displacement(rows) if self._keeps_fields else None
        return Frames(sensor.packed(rows), table, lines, fields)


def join(
    sensors: Sequence[SensorSelection],
    tolerances: Tolerances | None = None,
    unseen: tuple[str, ...] | None = None,
    wrenches: Mapping[str, NDArray[np.float64]] | None = None,
) -> Joined:
    """Find which presses of some sensors, with different names, match; nothing is written.

    Without `unseen`, models may be trained on the indenters as in the archives; `wrenches` of all
    rows (n, 6) of sensors replace those of their archives.
    """
    chosen = tolerances or Tolerances()
    _require_names(sensors)
    _require_seen_alike(sensors, unseen)
    presses = [read_presses(each) for each in sensors]
    numbers = match(presses, chosen)
    pairs = tuple(
        compare(presses[one], presses[other], (numbers[one], numbers[other]), chosen)
        for one in range(len(presses))
        for other in range(one + 1, len(presses))
    )
    if not any(pair.matched for pair in pairs):
        listed = "\n".join(line for pair in pairs for line in pair.lines())
        raise LearningError(f"no press matched within {chosen}\n{listed}")
    indenters = coded(name for each in sensors for name in each.archive.indenters)
    target, location = _numbered(presses, numbers, indenters)
    most = 1 + max((int(some.max()) for some in target), default=0)
    return Joined(
        tuple(
            _joined(each, sensors, indenters, locations, number, most, unseen, wrenches or {})
            for each, locations, number in zip(presses, location, target, strict=True)
        ),
        indenters,
        pairs,
        chosen,
    )


def _require_names(sensors: Sequence[SensorSelection]) -> None:
    if len(sensors) < 2:
        raise LearningError(f"sensors: found {len(sensors)}; allowed: two or more")
    by_name: dict[str, SensorSelection] = {}
    for each in sensors:
        other = by_name.setdefault(each.name, each)
        if other is not each:
            raise LearningError(
                f"{each.name}: found in {other.archive.name} and in {each.archive.name}; allowed: "
                f"another name for one of both, as in {each.archive.name}:{each.sensor}=NAME"
            )


def _require_seen_alike(sensors: Sequence[SensorSelection], unseen: tuple[str, ...] | None) -> None:
    """Reject archives that disagree on the indenters that models may be trained on."""
    if unseen is not None:
        return
    first_of: dict[str, tuple[bool, SensorSelection]] = {}
    for each in sensors:
        table = each.archived.table
        for code, seen in np.unique(np.stack([table["indenter"], table["seen"]], 1), axis=0):
            name = each.archive.indenters[int(code)]
            before, other = first_of.setdefault(name, (bool(seen), each))
            if before != bool(seen):
                raise LearningError(
                    f"{name}: models may be trained on it by {(each if seen else other).name}, not "
                    f"by {(other if seen else each).name}; allowed: --unseen, for all sensors"
                )


def _numbered(
    presses: Sequence[PlacedPresses], numbers: Sequence[Integers], indenters: tuple[str, ...]
) -> tuple[list[Integers], list[Integers]]:
    """Return target and location of each press; states of one target keep a common target."""
    count = 1 + max(int(number.max()) for number in numbers)
    group = np.arange(count)
    for each, number in zip(presses, numbers, strict=True):
        _merge(group, each, number)
    code = np.zeros(count, np.int64)
    for each, number in zip(presses, numbers, strict=True):
        code[number] = [indenters.index(name) for name in each.indenter]
    target = np.zeros(count, np.int64)
    for one in np.unique(code):
        members = np.flatnonzero(code == one)
        target[members] = np.unique(group[members], return_inverse=True)[1].reshape(-1)
    location = np.empty(count, np.int64)
    location[np.lexsort((np.arange(count), target, code))] = np.arange(count)
    for each, number in zip(presses, numbers, strict=True):
        _require_targets_apart(each, target[number])
    return [target[number] for number in numbers], [location[number] for number in numbers]


def _merge(group: Integers, presses: PlacedPresses, number: Integers) -> None:
    """Give all places of one target the lowest group among them."""
    first: dict[tuple[str, int], int] = {}
    for name, target, index in zip(
        presses.indenter.tolist(), presses.target.tolist(), number.tolist(), strict=True
    ):
        one = first.setdefault((name, target), index)
        if group[one] != group[index]:
            low, high = sorted((int(group[one]), int(group[index])))
            group[group == high] = low


def _require_targets_apart(presses: PlacedPresses, target: Integers) -> None:
    own_target: dict[tuple[str, int], int] = {}
    for name, own, new in zip(
        presses.indenter.tolist(), presses.target.tolist(), target.tolist(), strict=True
    ):
        if (other := own_target.setdefault((name, new), own)) != own:
            raise LearningError(
                f"{presses.of.name}: its targets {other} and {own} of {name} match different "
                "depths of one target of another sensor; allowed: archives with one target each"
            )


def _joined(
    presses: PlacedPresses,
    sensors: Sequence[SensorSelection],
    indenters: tuple[str, ...],
    location: Integers,
    target: Integers,
    most: int,
    unseen: tuple[str, ...] | None,
    wrenches: Mapping[str, NDArray[np.float64]],
) -> JoinedSensor:
    chosen = presses.of
    sensor = chosen.archived
    table = sensor.table
    located = table["location"] >= 0
    of_row = mapped(table["location"], presses.location, target)
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
        location=mapped(table["location"], presses.location, location),
        target=of_row,
        unseen=unseen,
        fields_of=named.get(owner) if owner is not None else None,
        wrench=np.asarray(wrenches.get(chosen.name, table["wrench"])),
    )
