"""Records sessions along any plan: starts the mock bench, if it is one, and the collector."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rig.acquire.collector import Collector
from rig.acquire.motion_notice import deepest
from rig.acquire.request import CollectRequest
from rig.bench.bench import Bench, BenchFile
from rig.cli.options import confirm_motion, log_to
from rig.core.sources import Sources
from trajectories import Plan

if TYPE_CHECKING:
    from rig.monitor.collection_page import CollectionPage


@dataclass(frozen=True, slots=True)
class StartedBench:
    """A bench that is ready to record one session after the other."""

    file: BenchFile
    """Its file, with the addresses of a mock bench's emulators."""
    watch: Callable[[], None] | None
    """Raises if an emulator of a mock bench is gone."""


@contextlib.contextmanager
def started_bench(
    file: BenchFile,
    *,
    sources: Sources | None = None,
    truth: Path | None = None,
    folder: Path | None = None,
) -> Iterator[StartedBench]:
    """Start the emulators of a mock bench for the context; a lab bench needs nothing.

    Args:
        file: The bench file.
        sources: Real recordings for a mock bench to play.
        truth: File for a mock bench to log the World's truth to.
        folder: Folder for the files of a mock bench; by default a temporary one.

    Raises:
        ConfigError, DeviceLost: An emulator did not start.
    """
    if not file.bench.mock:
        yield StartedBench(file, None)
        return
    # Imported here, so that a collection on lab devices loads no emulator.
    from rig.mock.bench import MockBench

    with contextlib.ExitStack() as stack:
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-")))
        mock = MockBench(file, folder, sources=sources, truth=truth)
        stack.enter_context(mock)
        yield StartedBench(mock.file, mock.check)


def record(
    file: BenchFile,
    request: CollectRequest,
    plan: Plan,
    *,
    total: int | None = None,
    prepared: Callable[[Bench], Bench],
    asked_by: int | None = None,
    sources: Sources | None = None,
    truth: Path | None = None,
    page: Callable[[Bench, Path], AbstractContextManager[CollectionPage | None]] | None = None,
    on: StartedBench | None = None,
) -> int:
    """Record `plan` from its first open target on and return the exit code.

    Args:
        file: The bench file.
        request: Where to record, and with which settings.
        plan: Targets to press.
        prepared: Returns the final bench: speeds, limits, calibrated frame. The mock's World
            does not see these changes.
        asked_by: Campaign that has asked if a lab bench may move; see `confirm_motion`.
        total: Number of the plan's targets to press; None: all.
        sources: Real recordings for a mock bench to play.
        truth: File for a mock bench to log the World's truth to.
        page: Opens the monitoring page, given the bench and the run folder.
        on: The bench, if it has been started; `sources` and `truth` are then unused.

    Raises:
        ConfigError, DeviceLost, SafetyStop, SessionError, Interrupted: Before anything was
            recorded.
    """
    confirm_motion(prepared(file.bench), deepest(plan, total), asked_by)
    request.path.parent.mkdir(parents=True, exist_ok=True)
    log_to(request.path.with_suffix(".log"))
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-")))
        if on is None:
            started = started_bench(file, sources=sources, truth=truth, folder=folder)
            on = stack.enter_context(started)
        bench = prepared(on.file.bench)
        shown = None if page is None else stack.enter_context(page(bench, folder))
        collector = Collector(bench, on.file.content, folder, on.watch, shown)
        return collector.run(request, plan, len(plan) if total is None else total)
