"""One session along any plan: the mock bench if there is one, then the collector."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rig.bench import Bench, bench_from
from rig.collect.collector import Collector
from rig.collect.order import Order
from rig.mock import MockBench
from trajectories import Plan


def record(
    path: Path,
    content: dict[str, Any],
    order: Order,
    plan: Plan,
    *,
    prepared: Callable[[Bench], Bench],
) -> int:
    """Record `plan` from its first target to its last; the exit code.

    Args:
        path: The bench file.
        content: It as read.
        order: Where to, and with what.
        plan: What to press.
        prepared: Last word on the bench: speeds, limits, the calibrated frame. The mock's World
            does not see it.

    Raises:
        ConfigError, DeviceLost, SafetyStop, SessionError: Before anything was recorded.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-")))
        watch = None
        if bench_from(content, str(path)).mock:
            mock = stack.enter_context(MockBench(content, str(path), folder))
            content, watch = mock.content, mock.check
        bench = prepared(bench_from(content, str(path)))
        return Collector(bench, content, folder, watch).run(order, plan, len(plan))
