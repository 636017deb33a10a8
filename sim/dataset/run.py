"""Create or resume an archive, make its missing units and close it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

import numpy as np
from scipy.special import gammainc

from recorder import SessionError
from recorder.archive import ArchivePlan, ArchiveWriter, MarkerArchive, MarkerCount, SensorPlan
from recorder.command_line.options import next_command
from recorder.markers import count_markers, unpack
from recorder.processes import Workers
from sim.dataset.generate import LATTICE, Packed, Reader, UnitStats, make_unit, reader
from sim.dataset.plan import (
    DatasetPlan,
    Family,
    Unit,
    described,
    differing,
    families,
    indenter_names,
    names,
    scenes,
    units,
)
from sim.device import ready_device
from sim.errors import SceneError
from sim.markers import named as pattern_named
from sim.result import to_json
from sim.sensors import CameraSignal, SimulatedSensor
from sim.tiers import FEWER, seconds_of

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
        SceneError: The path holds something else, or an archive of another plan; the message names
            every key that differs.
        OSError: The disk is full, or the path is not writable.
    """
    if path.exists():
        opened = found(path)
        keys = differing(opened.plan.document(), plan.document())
        if keys:
            resume = next_command("sim", "archive", path)
            raise SceneError(
                f"{path}: was begun with another plan, which differs in {', '.join(keys)}; "
                f"allowed: the same options, another path, or `{resume}`"
            )
        return opened
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        ArchiveWriter.begin(path, archive_plan(plan, device))
    except SessionError as error:
        raise SceneError(str(error)) from error
    return OpenArchive(path, plan)


def found(path: Path) -> OpenArchive:
    """Open the archive at `path` and the plan in it.

    Raises:
        SceneError: There is no archive, it is not of simulated sensors, or its plan is invalid.
    """
    try:
        attrs = MarkerArchive(path).attrs
    except SessionError as error:
        raise SceneError(str(error)) from error
    if PLAN not in attrs:
        raise SceneError(f"{path}: attribute {PLAN!r} is missing; allowed: a simulated archive")
    plan = DatasetPlan.of(attrs[PLAN], f"{path}.plan")
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
        made.name: made for family in families(plan) for made in _sensor_plans(plan, family, device)
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
        PLAN: plan.document(),
        "patterns": {name: to_json(pattern_named(name)) for name in patterns},
    }
    return ArchivePlan(tuple(by_name[name] for name in order), indenter_names(plan), attrs)


def _sensor_plans(plan: DatasetPlan, family: Family, device: str) -> Iterator[SensorPlan]:
    rows = family.recordings * family.rows_each
    for each in family.sensors:
        seen = reader(each, plan.seed, device, len(indenter_names(plan)))
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


# Ctrl-C while an archive is made: the first ends after the units in flight, the second at once.


class Stop:
    """Context manager that handles Ctrl-C, in the main thread only."""

    def __init__(self, say: Callable[[str], None] = lambda line: None) -> None:
        """Call `say` with a line of text at the first Ctrl-C, when units in flight remain."""
        self._say = say
        self._before: Any = None
        self.asked = False
        """True if no further unit should begin."""

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._take)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._before is not None:
            signal.signal(signal.SIGINT, self._before)

    def _take(self, number: int, frame: FrameType | None) -> None:
        if self.asked:
            raise KeyboardInterrupt
        self.asked = True
        self._say("stopping: the units in flight are finished first; Ctrl-C again stops at once")


# Called with the fraction of the current unit's presses that is solved (units made one at a time).
Inside = Callable[[float], None]
# Makes units and yields the statistics of each when it is done.
Maker = Callable[[Sequence[Unit], Inside], Iterator[UnitStats]]


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Summary of one run."""

    complete: bool
    """True if the archive is complete, False if the run was stopped before."""
    images: int
    """Number of masks that this run wrote."""
    seconds: float
    """Duration of the run [s]."""
    solving: float
    """CPU time of presses [s]; on a GPU, wall-clock time."""
    seeing: float
    """The same for images, fields, packing and writing."""
    left: int
    """Number of units still missing."""


def fill(
    opened: OpenArchive, maker: Maker, stop: Stop, progress: Callable[[float], None]
) -> RunSummary:
    """Make the missing units and close the archive.

    Args:
        opened: The archive.
        maker: Makes the missing units.
        stop: Request to stop, after which units may be missing on purpose.
        progress: Called with the fraction of all rows that are written.
    """
    began = time.perf_counter()
    missing = opened.missing()
    weights = {unit.number: _rows(opened, unit) for unit in units(opened.plan)}
    whole = sum(weights.values())
    done = whole - sum(weights[unit.number] for unit in missing)
    progress(done / whole)
    made: list[UnitStats] = []

    def inside(fraction: float) -> None:
        """Report progress within a unit; presses take most of its time, units come in order."""
        now = missing[len(made)].number
        progress((done + fraction * weights[now]) / whole)

    for one in maker(missing, inside):
        made.append(one)
        done += weights[one.number]
        progress(done / whole)
    left = opened.missing() if stop.asked else ()
    if not left:
        ArchiveWriter(opened.path).finish()
    return RunSummary(
        complete=not left,
        images=sum(one.images for one in made),
        seconds=time.perf_counter() - began,
        solving=sum(one.solving for one in made),
        seeing=sum(one.seeing for one in made),
        left=len(left),
    )


def _rows(opened: OpenArchive, unit: Unit) -> int:
    family = families(opened.plan)[unit.family]
    presses = family.presses[unit.first : unit.last]
    return sum(len(one) for press in presses for one in press.recordings)


# Units made on this machine: one after the other, or one at a time per process.

# Environment that keeps a worker to one core, and its sums in a fixed order.
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


def make_here(
    opened: OpenArchive,
    units: Sequence[Unit],
    inside: Callable[[float], None] | None = None,
    *,
    device: str,
    stop: Stop,
    processes: int = 1,
) -> Iterator[UnitStats]:
    """Make units one by one in this process, as a GPU needs.

    Args:
        opened: The archive.
        units: Its missing units.
        inside: Called with the fraction of the unit's presses that are solved.
        device: Device to solve and render on.
        stop: Request to stop, checked between units.
        processes: Processes that render the images of a unit; 1: this one does.

    Raises:
        SceneError, OSError, WorkerLost: As `make_unit`.
    """
    several = Workers(processes, ready_device, device, fewer=FEWER) if processes > 1 else None
    with several or contextlib.nullcontext():
        for unit in units:
            if stop.asked:
                return
            yield make_unit(opened.path, opened.plan, unit, device, inside, several)


def make_in_processes(
    opened: OpenArchive,
    units: Sequence[Unit],
    inside: object = None,
    *,
    processes: int,
    stop: Stop,
    device: str = "cpu",
) -> Iterator[UnitStats]:
    """Make units in parallel and yield each when it is done; each process has one thread.

    Args:
        opened: The archive.
        units: Its missing units.
        inside: Not called, because several units are in progress.
        processes: Most processes to use.
        stop: Request to stop, checked before each unit.
        device: Device for presses and images.

    Raises:
        SceneError, OSError: As `make_unit`; units in flight are abandoned.
        WorkerLost: A process was killed, for example for lack of memory.
    """
    rest = iter(units)
    pending: set[Future[UnitStats]] = set()
    done = 0
    # Warp renders the images of every tier.
    workers = Workers(max(1, min(processes, len(units))), ready_device, device, fewer=FEWER)
    workers.done = f"0 of {len(units)} units"
    with workers:
        while True:
            # Submit only units that can start at once, so that a stop takes effect.
            while len(pending) < processes and not stop.asked:
                unit = next(rest, None)
                if unit is None:
                    break
                with _one_thread():
                    pending.add(workers.submit(make_unit, opened.path, opened.plan, unit, device))
            if not pending:
                return
            ready, pending = wait(pending, return_when=FIRST_COMPLETED)
            for task in ready:
                yield task.result()
                done += 1
                workers.done = f"{done} of {len(units)} units"


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Limit processes started inside to one thread for linear algebra."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


# Cost estimate of an archive, printed before it is begun.

# Presses of a family whose time is estimated; their mean serves for the others.
SAMPLES = 3
# CPU time of a frame, of each of its masks, and extra with segmentation errors [s].
SECONDS_VIEW, SECONDS_MASK, SECONDS_SEGMENTED = 15e-3, 3e-3, 25e-3
# Compressed size of a mask and of a displacement field: means over the paper's states.
BYTES_MASK, BYTES_FIELD = 2_800, 12_600


@dataclass(frozen=True, slots=True)
class Cost:
    """Estimated cost of the remaining work."""

    presses: int
    """Number of scenes to solve."""
    frames: int
    """Number of their frames, over all families."""
    images: int
    """Number of masks to render from the frames."""
    size: float
    """Approximate size in bytes."""
    solving: float | None
    """Approximate CPU time of the presses [s]; None if there is no estimate."""
    seeing: float
    """The same for images [s]."""
    how: tuple[str, ...]
    """Description of the solver's settings for each kind of body."""

    def seconds(self, processes: int) -> float | None:
        """Return the approximate time with that number of processes [s]."""
        return None if self.solving is None else (self.solving + self.seeing) / processes


def cost(plan: DatasetPlan, missing: Sequence[Unit], device: str = "cpu") -> Cost:
    """Estimate the cost of units; time of presses only on `cpu`, to about a factor of two."""
    presses = frames = images = 0
    size = seeing = 0.0
    solving: float | None = 0.0
    for index, family in enumerate(families(plan)):
        some = [unit for unit in missing if unit.family == index]
        count = sum(unit.last - unit.first for unit in some)
        rows = sum(
            len(one)
            for unit in some
            for press in family.presses[unit.first : unit.last]
            for one in press.recordings
        )
        presses, frames = presses + count, frames + rows
        images += rows * len(family.names)
        for each in family.sensors:
            size += rows * _bytes(each)
            seeing += rows * _seconds_seeing(each)
        one_press = _seconds_press(plan, family, device) if some else 0.0
        solving = None if solving is None or one_press is None else solving + count * one_press
    how = dict.fromkeys(described(plan.solving, each.body) for each in plan.sensors)
    return Cost(presses, frames, images, size, solving, seeing, tuple(how))


def _bytes(each: SimulatedSensor) -> float:
    fields = isinstance(each.signal, CameraSignal)
    return len(names(each)) * BYTES_MASK + fields * BYTES_FIELD


def _seconds_seeing(each: SimulatedSensor) -> float:
    if not isinstance(each.signal, CameraSignal):
        return SECONDS_MASK
    segmented = 0.0 if each.variation.segmentation is None else SECONDS_SEGMENTED
    return SECONDS_VIEW + len(names(each)) * (SECONDS_MASK + segmented)


def _seconds_press(plan: DatasetPlan, family: Family, device: str) -> float | None:
    """Return the mean time of a press [s]; None if unknown: on a GPU, or with a tolerance."""
    if device != "cpu" or plan.solving.tolerance is not None:
        return None
    places = np.linspace(0, len(family.presses) - 1, SAMPLES + 2).round().astype(int)[1:-1]
    chosen = tuple(family.presses[place] for place in dict.fromkeys(places.tolist()))
    tried = scenes(plan, family, chosen)
    return float(np.mean([seconds_of(one, plan.solving.settings(one.body)) for one in tried]))
