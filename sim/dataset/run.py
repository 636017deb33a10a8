"""An archive filled with what it lacks, by whoever makes units, and closed."""

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
from uuid import uuid4

import numpy as np
from scipy.stats import poisson

from recorder import SessionError
from recorder.archive import ArchivePlan, ArchiveWriter, MarkerArchive, MarkerCount, SensorPlan
from recorder.markers import count_markers, unpack
from recorder.processes import WorkerLost, Workers
from sim.dataset.generate import LATTICE, Made, Packed, Reader, make_unit, reader
from sim.dataset.plan import (
    Family,
    Plan,
    Solving,
    Unit,
    described,
    differing,
    families,
    names,
    scenes,
    units,
)
from sim.device import ready_device
from sim.errors import SceneError
from sim.indenters import NAMES
from sim.markers import named as pattern_named
from sim.result import to_json
from sim.scene import Scene
from sim.sensors import CameraSignal, SimulatedSensor
from sim.tiers import FEWER

# An archive begun from a plan, or found again with its plan in it.

# Attribute of an archive that holds what it is made from, and "made_by" what made it.
PLAN = "plan"
MADE_BY = "tactile-rig sim archive"
# Chance of a frame in which segmentation misses more markers than the marker check lets pass.
LEAST_LIKELY = 1e-5


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


# Ctrl-C while an archive is made: once ends after the units in flight, twice ends at once.


class Stop:
    """Takes Ctrl-C while it is open: a context manager, of the main thread alone."""

    def __init__(self, say: Callable[[str], None] = lambda line: None) -> None:
        """Call `say` once when units in flight are waited for."""
        self._say = say
        self._before: Any = None
        self.asked = False
        """Whether no unit should begin any more."""

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


# Told how much of the presses of the unit in hand is solved, where there is one at a time.
Inside = Callable[[float], None]
# Makes units and tells of each that is done.
Maker = Callable[[Sequence[Unit], Inside], Iterator[Made]]


@dataclass(frozen=True, slots=True)
class Filled:
    """What one run did."""

    complete: bool
    """Whether the archive is; not when it was stopped."""
    images: int
    """Masks that this run wrote."""
    seconds: float
    """Time that it took."""
    solving: float
    """CPU time of presses [s]; on a GPU the time that they took."""
    seeing: float
    """The same of images, fields, packing and writing."""
    left: int
    """Units that are still missing."""


def fill(begun: Begun, maker: Maker, stop: Stop, progress: Callable[[float], None]) -> Filled:
    """Make what is missing and close the archive.

    Args:
        begun: The archive.
        maker: Makes the missing units.
        stop: Whether the maker left some on purpose.
        progress: Called with the share of all rows that are there.
    """
    began = time.perf_counter()
    missing = begun.missing()
    weights = {unit.number: _rows(begun, unit) for unit in units(begun.plan)}
    whole = sum(weights.values())
    done = whole - sum(weights[unit.number] for unit in missing)
    progress(done / whole)
    made: list[Made] = []

    def inside(share: float) -> None:
        """Presses are nearly all of a unit, and units are made in their order here."""
        now = missing[len(made)].number
        progress((done + share * weights[now]) / whole)

    for one in maker(missing, inside):
        made.append(one)
        done += weights[one.number]
        progress(done / whole)
    left = begun.missing() if stop.asked else ()
    if not left:
        ArchiveWriter(begun.path).finish()
    return Filled(
        complete=not left,
        images=sum(one.images for one in made),
        seconds=time.perf_counter() - began,
        solving=sum(one.solving for one in made),
        seeing=sum(one.seeing for one in made),
        left=len(left),
    )


def _rows(begun: Begun, unit: Unit) -> int:
    family = families(begun.plan)[unit.family]
    presses = family.presses[unit.first : unit.last]
    return sum(len(one) for press in presses for one in press.recordings)


# Units made on this machine: one after the other, or one a process at a time.

# What keeps a worker to one core, and its sums in one order.
ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}


def make_here(
    begun: Begun,
    units: Sequence[Unit],
    inside: Callable[[float], None] | None = None,
    *,
    device: str,
    stop: Stop,
) -> Iterator[Made]:
    """Make units one by one in this process, as a GPU wants it.

    Args:
        begun: The archive.
        units: What is missing of it.
        inside: Called with the share of the unit's presses that are solved.
        device: Where.
        stop: Asked between units.

    Raises:
        SceneError, OSError: As `make_unit`.
    """
    for unit in units:
        if stop.asked:
            return
        yield make_unit(begun.path, begun.plan, unit, device, inside)


def make_in_processes(
    begun: Begun,
    units: Sequence[Unit],
    inside: object = None,
    *,
    processes: int,
    stop: Stop,
    device: str = "cpu",
) -> Iterator[Made]:
    """Make units in the order in which they are done; each process has one thread.

    Args:
        begun: The archive.
        units: What is missing of it.
        inside: Not called: several units are in hand.
        processes: How many at most.
        stop: Asked before each unit.
        device: Where images are made; presses too, but those of `layer`.

    Raises:
        SceneError, OSError: As `make_unit`; units in flight are given up.
        WorkerLost: A process was killed, by a lack of memory for example.
    """
    rest = iter(units)
    pending: set[Future[Made]] = set()
    done = 0
    # Images are made by Warp, whatever the tier.
    workers = Workers(max(1, min(processes, len(units))), ready_device, device, fewer=FEWER)
    workers.done = f"0 of {len(units)} units"
    with workers:
        while True:
            # No more than are worked on, so that a stop is one.
            while len(pending) < processes and not stop.asked:
                unit = next(rest, None)
                if unit is None:
                    break
                with _one_thread():
                    pending.add(workers.submit(make_unit, begun.path, begun.plan, unit, device))
            if not pending:
                return
            ready, pending = wait(pending, return_when=FIRST_COMPLETED)
            for task in ready:
                yield task.result()
                done += 1
                workers.done = f"{done} of {len(units)} units"


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are started inside have one thread for sums of matrices."""
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


# Units made by the workers of a Dask cluster, which write them to a file system that all share.
#
# A worker that is killed loses nothing: its unit runs again elsewhere, and a unit that two of them
# write is the same twice.

# How long the first worker is waited for [s].
WORKERS_WITHIN = 30.0
# A worker with several threads makes one unit at a time all the same.
_ONE_AT_A_TIME = threading.Lock()


def make_on_cluster(
    begun: Begun,
    units: Sequence[Unit],
    inside: object = None,
    *,
    address: str,
    device: str,
    stop: Stop,
) -> Iterator[Made]:
    """Make units, in the order in which they are done.

    Args:
        begun: The archive; its path is the same for every worker.
        units: What is missing of it.
        inside: Not called: several units are in hand.
        address: Of the scheduler, such as `tcp://host:8786`.
        device: Where each worker makes its units.
        stop: Once asked, units that no worker has are left.

    Raises:
        SceneError: Dask is not installed, or nobody answers; and as `make_unit`.
        OSError: As `make_unit`.
        WorkerLost: A unit took several workers with it, so that Dask gave up.
    """
    distributed = _distributed()
    try:
        client = distributed.Client(address, timeout=WORKERS_WITHIN, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SceneError(f"--scheduler: {address!r}: {error}; allowed: one that runs") from error
    path, run = begun.path.resolve(), uuid4().hex
    rest = iter(units)
    with client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_WITHIN)
        except TimeoutError as error:
            raise SceneError(
                f"--scheduler: {address!r} has no workers; allowed: one that has"
            ) from error
        done = distributed.as_completed(loop=client.loop)
        flying: dict[str, Any] = {}
        try:
            while True:
                # Twice as many as there are threads, so that nobody waits for us.
                room = 2 * max(1, sum(client.nthreads().values()))
                while len(flying) < room and not stop.asked:
                    unit = next(rest, None)
                    if unit is None:
                        break
                    future = client.submit(
                        make_there,
                        path,
                        begun.plan,
                        unit,
                        device,
                        key=f"unit-{run}-{unit.number}",
                        pure=False,
                    )
                    flying[future.key] = future
                    done.add(future)
                if not flying:
                    return
                future = next(done)
                del flying[future.key]
                yield _result(distributed, future)
        finally:
            client.cancel(list(flying.values()), force=True)


def make_there(path: Path, plan: Plan, unit: Unit, device: str) -> Made:
    """Make a unit in a worker of the cluster."""
    with _ONE_AT_A_TIME:
        ready_device(device)
        return make_unit(path, plan, unit, device)


def _result(distributed: Any, future: Any) -> Made:
    try:
        made: Made = future.result()
    except distributed.KilledWorker as error:
        raise WorkerLost(
            f"{future.key}: every worker that took it was killed, most likely for lack of memory; "
            "allowed: more memory each, or fewer presses together"
        ) from error
    return made


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise SceneError(
            "--scheduler: dask.distributed is not installed; allowed: "
            "pip install 'tactile-rig[cluster]'"
        ) from error
    return distributed


# What an archive will take, told before it is begun.

# Presses of a family whose seconds are foretold; the others take their mean.
SAMPLES = 3
# CPU time of a press by `layer`, and of each of its frames [s].
SECONDS_LAYER, SECONDS_LAYER_FRAME = 0.2, 0.015
# CPU time of an element in an iteration of Newton's method [s], and iterations a step: of 20
# presses with friction they took 5 to 20, and an element 5 to 10 us.
SECONDS_ITERATION, ITERATIONS = 6e-6, 8
# CPU time of a frame, of each of its masks, and of one with errors of segmentation [s].
SECONDS_VIEW, SECONDS_MASK, SECONDS_SEGMENTED = 15e-3, 3e-3, 25e-3
# What a mask and a displacement field take when compressed: means over the paper's states.
BYTES_MASK, BYTES_FIELD = 2_800, 12_600


@dataclass(frozen=True, slots=True)
class Cost:
    """What is still to be done."""

    presses: int
    """Scenes to solve."""
    frames: int
    """Frames of them, of all families."""
    images: int
    """Masks that are made of the frames."""
    size: float
    """Bytes, about."""
    solving: float | None
    """CPU time of the presses [s], about; None where nothing is known of such presses."""
    seeing: float
    """The same of images [s]."""
    how: tuple[str, ...]
    """How presses are solved, in words, for each kind of body."""

    def seconds(self, processes: int) -> float | None:
        """Time that so many processes take, about [s]."""
        return None if self.solving is None else (self.solving + self.seeing) / processes


def cost(plan: Plan, missing: Sequence[Unit], device: str = "cpu") -> Cost:
    """What units take; presses are foretold on device `cpu` only, within a factor of two or so."""
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
    segmented = 0.0 if each.life.segmentation is None else SECONDS_SEGMENTED
    return SECONDS_VIEW + len(names(each)) * (SECONDS_MASK + segmented)


def _seconds_press(plan: Plan, family: Family, device: str) -> float | None:
    """Mean time of a press [s]; None where that is not known: on a GPU, or within a tolerance."""
    if device != "cpu" or plan.solving.tolerance is not None:
        return None
    places = np.linspace(0, len(family.presses) - 1, SAMPLES + 2).round().astype(int)[1:-1]
    chosen = tuple(family.presses[place] for place in dict.fromkeys(places.tolist()))
    return float(np.mean([_foretold(one, plan.solving) for one in scenes(plan, family, chosen)]))


def _foretold(scene: Scene, solving: Solving) -> float:
    numerics = solving.numerics(scene.body)
    if numerics is None:
        return SECONDS_LAYER + SECONDS_LAYER_FRAME * len(scene.motion)
    from sim.fem.mesh import meshes_of
    from sim.fem.newton import path_of

    elements = len(meshes_of([scene], numerics)[0].elements)
    return SECONDS_ITERATION * elements * ITERATIONS * path_of(scene, numerics).steps
