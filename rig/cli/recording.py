"""Records one session along any plan: starts the mock bench, if it is one, and the collector."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.acquire.collector import Collector
from rig.acquire.motion_notice import deepest
from rig.acquire.request import CollectRequest
from rig.bench.bench import Bench, bench_from
from rig.cli.options import confirm_motion, log_to
from rig.core.sources import Sources
from trajectories import Plan

if TYPE_CHECKING:
    from rig.monitor.page.page import Page


def record(
    path: Path,
    content: dict[str, Any],
    request: CollectRequest,
    plan: Plan,
    *,
    total: int | None = None,
    prepared: Callable[[Bench], Bench],
    asked_by: int | None = None,
    sources: Sources | None = None,
    truth: Path | None = None,
    page: Callable[[Bench, Path], AbstractContextManager[Page | None]] | None = None,
) -> int:
    """Record `plan` from its first open target on and return the exit code.

    Args:
        path: The bench file.
        content: Content of the bench file.
        request: Where to record, and with which settings.
        plan: Targets to press.
        prepared: Returns the final bench: speeds, limits, calibrated frame. The mock's World
            does not see these changes.
        asked_by: Campaign that has asked if a lab bench may move; see `confirm_motion`.
        total: Number of the plan's targets to press; None: all.
        sources: Real recordings for a mock bench to play.
        truth: File for a mock bench to log the World's truth to.
        page: Opens the monitoring page, given the bench and the run folder.

    Raises:
        ConfigError, DeviceLost, SafetyStop, SessionError, Interrupted: Before anything was
            recorded.
    """
    confirm_motion(prepared(bench_from(content, str(path))), deepest(plan, total), asked_by)
    request.path.parent.mkdir(parents=True, exist_ok=True)
    log_to(request.path.with_suffix(".log"))
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-")))
        watch = None
        if bench_from(content, str(path)).mock:
            # Imported here, so that a collection on lab devices loads no emulator.
            from rig.mock.bench import MockBench

            mock = stack.enter_context(
                MockBench(content, str(path), folder, sources=sources, truth=truth)
            )
            content, watch = mock.content, mock.check
        bench = prepared(bench_from(content, str(path)))
        shown = None if page is None else stack.enter_context(page(bench, folder))
        collector = Collector(bench, content, folder, watch, shown)
        return collector.run(request, plan, len(plan) if total is None else total)
