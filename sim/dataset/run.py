"""Create or resume an archive, make its missing units and close it."""

import json
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import gammainc

from recorder.archive import ArchivePlan, ArchiveWriter, MarkerArchive, MarkerCount, SensorPlan
from recorder.command_line.options import next_command
from recorder.markers import count_markers, unpack
from recorder.processes import Workers, environment, several
from recorder.settings import differing_keys
from sim.arrays import Progress
from sim.dataset.generate import LATTICE, Packed, SensorReader, make_unit, sensor_reader
from sim.dataset.plan import (
    DatasetPlan,
    Family,
    Unit,
    described,
    families,
    indenter_names,
    names,
    units,
)
from sim.device import ready_device
from sim.errors import SceneError
from sim.markers import named as pattern_named
from sim.result import from_json, to_json
from sim.sensors import CameraReadout, CameraSignal, SimulatedSensor
from sim.tiers import FEWER

# Archives: created from a plan, or reopened with the plan stored in them.

# Attribute of an archive that holds its plan, and value of its attribute "made_by".
PLAN = "plan"
MADE_BY = "tactile-rig sim archive"
# Probability that segmentation misses more markers of a frame than the marker check tolerates.
LEAST_LIKELY = 1e-5


@dataclass(frozen=True, slots=True)
class OpenArchive:
    """An archive to fill, with its plan."""

    path: Path
    plan: DatasetPlan

    def missing(self) -> tuple[Unit, ...]:
        """Return the units with missing files."""
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


def begin(path: Path, plan: DatasetPlan, device: str = "cpu") -> OpenArchive:
    """Create the archive of a plan, or reopen the one that the same plan created.

    Raises:
        SessionError: The path holds something else.
        SceneError: It holds an archive of another plan; the message names every key that differs.
        OSError: The disk is full, or the path is not writable.
    """
    if path.exists():
        opened = reopened(path)
        keys = differing_keys(to_json(opened.plan), to_json(plan))
        if keys:
            resume = next_command("sim", "archive", path)
            raise SceneError(
                f"{path}: was begun with another plan, which differs in {', '.join(keys)}; "
                f"allowed: the same options, another path, or `{resume}`"
            )
        return opened
    path.parent.mkdir(parents=True, exist_ok=True)
    ArchiveWriter.begin(path, archive_plan(plan, device))
    return OpenArchive(path, plan)


def reopened(path: Path) -> OpenArchive:
    """Open the archive at `path` and the plan in it.

    Raises:
        SessionError: There is no archive.
        SceneError: It is not of simulated sensors, or its plan is invalid.
    """
    attrs = MarkerArchive(path).attrs
    if PLAN not in attrs:
        raise SceneError(f"{path}: attribute {PLAN!r} is missing; allowed: a simulated archive")
    plan = from_json(DatasetPlan, attrs[PLAN], f"{path}.plan")
    changed = [
        name
        for name, stored in attrs.get("patterns", {}).items()
        if json.loads(json.dumps(to_json(pattern_named(name)))) != stored
    ]
    if changed:
        raise SceneError(
            f"{path}: was begun with other definitions of the patterns {', '.join(changed)}; "
            "allowed: the version of this program that began it, or another path"
        )
    return OpenArchive(path, plan)


def archive_plan(plan: DatasetPlan, device: str = "cpu") -> ArchivePlan:
    """Return the recorder's plan of the archive, with rendered references."""
    by_name = {
        sensor_plan.name: sensor_plan
        for family in families(plan)
        for sensor_plan in _sensor_plans(plan, family, device)
    }
    order = [name for each in plan.sensors for name in names(each)]
    patterns = sorted(
        {
            name
            for each in plan.sensors
            if isinstance(each.signal, CameraSignal) and each.signal.layout is None
            for name in each.signal.patterns
        }
    )
    attrs: dict[str, Any] = {
        "made_by": MADE_BY,
        PLAN: to_json(plan),
        "patterns": {name: to_json(pattern_named(name)) for name in patterns},
    }
    return ArchivePlan(tuple(by_name[name] for name in order), indenter_names(plan), attrs)


def _sensor_plans(plan: DatasetPlan, family: Family, device: str) -> Iterator[SensorPlan]:
    rows = family.recordings * family.rows_each
    for each in family.sensors:
        reader = sensor_reader(each, plan.seed, device, len(indenter_names(plan)))
        references, imaged = reader.references(), isinstance(reader.readout, CameraReadout)
        owner = names(each)[0]
        for index, name in enumerate(names(each)):
            own = imaged and index == 0
            yield SensorPlan(
                name=name,
                rows=rows,
                chunk_rows=family.rows_each,
                unit_rows=family.rows_each * family.unit_presses,
                references=references[index],
                mm_per_px=reader.readout.mm_per_px,
                lattice=LATTICE if own else None,
                displacement_of=owner if imaged and not own else None,
                marker_count=_marker_count(each, references[index]),
                attrs=_sensor_attrs(each, reader, index),
            )


def _sensor_attrs(each: SimulatedSensor, reader: SensorReader, index: int) -> dict[str, Any]:
    attrs: dict[str, Any] = {"sensor": each.name, "description": each.description}
    if isinstance(reader.readout, CameraReadout):
        attrs["pattern"] = reader.readout.patterns[index]
        attrs["camera"] = to_json(reader.readout.camera)
    if each.trajectory is not None:
        attrs["targets"] = len(each.trajectory)
    return attrs


def _marker_count(each: SimulatedSensor, references: Packed) -> MarkerCount | None:
    """Return the marker check; its tolerance allows for markers that segmentation misses."""
    if not isinstance(each.signal, CameraSignal):
        return None
    errors = each.variation.segmentation
    if errors is None:
        return MarkerCount()
    # An upper bound: every marker counts as lying in the rim as well.
    missed = count_markers(unpack(references[0])) * (errors.missing + errors.rim_missing)
    return MarkerCount(tolerance=most_of_poisson(LEAST_LIKELY, missed))


def most_of_poisson(chance: float, mean: float) -> int:
    """Return the least number that a Poisson variable exceeds with at most this chance."""
    # The chance of more than k is the regularised incomplete gamma function of k + 1.
    above = gammainc(np.arange(1.0, 2 * mean + 50), mean)
    return int(np.argmax(above <= chance))


# Makes units and yields each when it is done, with the number of masks that it wrote. Progress is
# that of the current unit's presses, if units are made one at a time.
Maker = Callable[[Sequence[Unit], Progress], Iterator[tuple[Unit, int]]]


def fill(opened: OpenArchive, maker: Maker, progress: Progress) -> int:
    """Make the missing units, close the archive, and return the number of masks written.

    `progress` is called with the fraction of all rows that are written.
    """
    missing = opened.missing()
    weights = {unit: _rows(opened.plan, unit) for unit in units(opened.plan)}
    whole = sum(weights.values())
    done = whole - sum(weights[unit] for unit in missing)
    progress(done / whole)
    image_counts: list[int] = []

    def inside(fraction: float) -> None:
        """Report progress within a unit; presses take most of its time, units come in order."""
        progress((done + fraction * weights[missing[len(image_counts)]]) / whole)

    for unit, images in maker(missing, inside):
        image_counts.append(images)
        done += weights[unit]
        progress(done / whole)
    ArchiveWriter(opened.path).finish()
    return sum(image_counts)


def _rows(plan: DatasetPlan, unit: Unit) -> int:
    presses = families(plan)[unit.family].presses[unit.first : unit.last]
    return sum(len(one) for press in presses for one in press.recordings)


# Units made on this machine: one after the other, or one at a time per process.

# Environment that keeps a worker to one core, and its sums in a fixed order.
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


def make_here(
    opened: OpenArchive,
    units: Sequence[Unit],
    inside: Progress | None = None,
    *,
    device: str,
    processes: int = 1,
) -> Iterator[tuple[Unit, int]]:
    """Make units one by one in this process, as a GPU needs; `processes` may render their images.

    `inside` is called with the fraction of the unit's presses that are solved.
    """
    with several(processes, ready_device, device, fewer=FEWER) as workers:
        for unit in units:
            yield unit, make_unit(opened.path, opened.plan, unit, device, inside, workers)


def make_in_processes(
    opened: OpenArchive,
    units: Sequence[Unit],
    inside: object = None,
    *,
    device: str = "cpu",
    processes: int,
) -> Iterator[tuple[Unit, int]]:
    """Make units in parallel and yield each when it is done; each process has one thread.

    `inside` is not called, because several units are in progress. After an error, which is
    `WorkerLost` if a process was killed, units in flight are abandoned.
    """
    # Warp renders the images of every tier.
    workers = Workers(max(1, min(processes, len(units))), ready_device, device, fewer=FEWER)
    workers.done = f"0 of {len(units)} units"
    with workers:
        with environment(**ONE_THREAD):
            due = {
                workers.submit(make_unit, opened.path, opened.plan, unit, device): unit
                for unit in units
            }
        for done, task in enumerate(as_completed(due), 1):
            yield due[task], task.result()
            workers.done = f"{done} of {len(units)} units"


# Compressed size of a mask and of a displacement field [bytes]: means over the paper's states.
BYTES_MASK, BYTES_FIELD = 2_800, 12_600


def contents(plan: DatasetPlan, missing: Sequence[Unit]) -> str:
    """Return the contents of units in words: presses, how they are solved, frames, images, size."""
    presses = frames = images = size = 0
    for unit in missing:
        family, rows = families(plan)[unit.family], _rows(plan, unit)
        fields = sum(isinstance(each.signal, CameraSignal) for each in family.sensors)
        presses, frames = presses + unit.last - unit.first, frames + rows
        images += rows * len(family.names)
        size += rows * (len(family.names) * BYTES_MASK + fields * BYTES_FIELD)
    how = "; ".join(dict.fromkeys(described(plan.solving, each.body) for each in plan.sensors))
    return (
        f"{presses:,} presses ({how}), {frames:,} frames, {images:,} images, about "
        f"{size / 1e6:,.0f} MB"
    )
