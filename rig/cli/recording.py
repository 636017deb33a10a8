"""One session along any plan: the mock bench if there is one, then the collector."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rig.acquire.collector import Collector
from rig.acquire.request import Order
from rig.bench.bench import Bench, bench_from
from rig.core.sources import Sources
from trajectories import Plan

if TYPE_CHECKING:
    from rig.monitor.page.page import Page


def record(
    path: Path,
    content: dict[str, Any],
    order: Order,
    plan: Plan,
    *,
    total: int | None = None,
    prepared: Callable[[Bench], Bench],
    sources: Sources | None = None,
    truth: Path | None = None,
    page: Callable[[Bench, Path], AbstractContextManager[Page | None]] | None = None,
) -> int:
    """Record `plan` from its first open target on; the exit code.

    Args:
        path: The bench file.
        content: It as read.
        order: Where to, and with what.
        plan: What to press.
        prepared: Last word on the bench: speeds, limits, the calibrated frame. The mock's World
            does not see it.
        total: How many of its targets; None: all.
        sources: Real recordings for a mock bench to serve.
        truth: File for a mock bench to log the World's truth to.
        page: Opens the page to watch on, given the bench and the run folder.

    Raises:
        ConfigError, DeviceLost, SafetyStop, SessionError: Before anything was recorded.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-")))
        watch = None
        if bench_from(content, str(path)).mock:
            # A collection at a lab's devices loads nothing that stands in for a device.
            from rig.mock.bench import MockBench

            mock = stack.enter_context(
                MockBench(content, str(path), folder, sources=sources, truth=truth)
            )
            content, watch = mock.content, mock.check
        bench = prepared(bench_from(content, str(path)))
        shown = None if page is None else stack.enter_context(page(bench, folder))
        collector = Collector(bench, content, folder, watch, shown)
        return collector.run(order, plan, len(plan) if total is None else total)
