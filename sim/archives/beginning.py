"""An archive begun from a plan, or found again with its plan in it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scipy.stats import poisson

from recorder import SessionError
from recorder.archive import ArchivePlan, ArchiveWriter, MarkerArchive, MarkerCount, SensorPlan
from recorder.markers import count_markers, unpack
from sim.archives.families import Family, Unit, families, units
from sim.archives.making import LATTICE
from sim.archives.plan import Plan, differing, names
from sim.archives.views import Packed, Reader, reader
from sim.errors import SceneError
from sim.indenters import NAMES
from sim.patterns import named as pattern_named
from sim.sensors import CameraSignal, SimulatedSensor
from sim.stored import to_json

PLAN = "plan"
"""Attribute of an archive that holds what it is made from, and "made_by" what made it."""
MADE_BY = "tactile-rig sim archive"
LEAST_LIKELY = 1e-5
"""Chance of a frame in which segmentation misses more markers than the marker check lets pass."""


@dataclass(frozen=True, slots=True)
class Begun:
    """An archive to be filled."""

    path: Path
    plan: Plan

    def missing(self) -> tuple[Unit, ...]:
        """Units of which some file is not there."""
        missing = ArchiveWriter(self.path).missing()
        if not missing:
            return ()
        of_family = [
            {number for name in family.names for number in missing.get(name, ())}
            for family in families(self.plan)
        ]
        return tuple(
            unit for unit in units(self.plan) if of_family[unit.family].intersection(unit.files)
        )


def begin(path: Path, plan: Plan, device: str = "cpu") -> Begun:
    """Create the archive of a plan, or go on with the one that the same plan began.

    Raises:
        SceneError: Something else lies there, or an archive of another plan: names every key.
        OSError: No room, or no leave to write there.
    """
    if path.exists():
        begun = found(path)
        keys = differing(begun.plan.document(), plan.document())
        if keys:
            raise SceneError(
                f"{path}: was begun with another plan, which differs in {', '.join(keys)}; "
                f"allowed: the same options, another path, or `python -m sim archive resume {path}`"
            )
        return begun
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        ArchiveWriter.begin(path, archive_plan(plan, device))
    except SessionError as error:
        raise SceneError(str(error)) from error
    return Begun(path, plan)


def found(path: Path) -> Begun:
    """The archive at `path` and the plan in it.

    Raises:
        SceneError: None there, not one of simulated sensors, or a plan that is not understood.
    """
    try:
        attrs = MarkerArchive(path).attrs
    except SessionError as error:
        raise SceneError(str(error)) from error
    if PLAN not in attrs:
        raise SceneError(f"{path}: attribute {PLAN!r} is missing; allowed: a simulated archive")
    plan = Plan.of(attrs[PLAN])
    changed = [
        name
        for name, stored in attrs.get("patterns", {}).items()
        if json.loads(json.dumps(to_json(pattern_named(name)))) != stored
    ]
    if changed:
        raise SceneError(
            f"{path}: was begun when the patterns {', '.join(changed)} were others; allowed: the "
            "version of this program that began it, or another path"
        )
    return Begun(path, plan)


def archive_plan(plan: Plan, device: str = "cpu") -> ArchivePlan:
    """The archive of a plan as the recorder has it, references rendered."""
    by_name = {
        made.name: made for family in families(plan) for made in _sensor_plans(plan, family, device)
    }
    order = [name for each in plan.sensors for name in names(each)]
    patterns = sorted(
        {
            name
            for each in plan.sensors
            if isinstance(each.signal, CameraSignal)
            for name in each.signal.patterns
        }
    )
    attrs: dict[str, Any] = {
        "made_by": MADE_BY,
        PLAN: plan.document(),
        "patterns": {name: to_json(pattern_named(name)) for name in patterns},
    }
    return ArchivePlan(tuple(by_name[name] for name in order), NAMES, attrs)


def _sensor_plans(plan: Plan, family: Family, device: str) -> Iterator[SensorPlan]:
    rows = family.recordings * family.rows_each
    for each in family.sensors:
        seen = reader(each, plan.seed, device)
        references = seen.references()
        owner = names(each)[0]
        for index, name in enumerate(names(each)):
            own = seen.keeps_fields and index == 0
            yield SensorPlan(
                name=name,
                rows=rows,
                chunk_rows=family.rows_each,
                unit_rows=family.rows_each * family.unit_presses,
                references=references[index],
                mm_per_px=seen.mm_per_px,
                lattice=LATTICE if own else None,
                displacement_of=owner if seen.keeps_fields and not own else None,
                marker_count=_marker_count(each, references[index]),
                attrs=_sensor_attrs(each, seen, index),
            )


def _sensor_attrs(each: SimulatedSensor, seen: Reader, index: int) -> dict[str, Any]:
    signal = each.signal
    attrs: dict[str, Any] = {"sensor": each.name, "description": each.description}
    if isinstance(signal, CameraSignal):
        attrs["pattern"] = signal.patterns[index]
        attrs["camera"] = to_json(seen.camera)
    if each.trajectory is not None:
        attrs["targets"] = len(each.trajectory)
    return attrs


def _marker_count(each: SimulatedSensor, references: Packed) -> MarkerCount | None:
    """How markers are counted: as many may be missing as segmentation misses now and then."""
    if not isinstance(each.signal, CameraSignal):
        return None
    errors = each.life.segmentation
    if errors is None:
        return MarkerCount()
    # As if every marker lay in the rim as well: never too few.
    missed = count_markers(unpack(references[0])) * (errors.missing + errors.rim_missing)
    return MarkerCount(tolerance=int(poisson.isf(LEAST_LIKELY, missed)) if missed > 0 else 0)
