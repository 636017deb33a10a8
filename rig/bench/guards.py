"""Guards of a bench: one for each gauge, or what stands in for a gauge."""

from __future__ import annotations

import math
from pathlib import Path

from rig.bench.bench import Bench
from rig.bench.no_gauge import FRACTION
from rig.core.guard import ForceGuard, Guard
from rig.core.stand_in_guards import CrashGuard, SignalGuard


def gauge_guards(bench: Bench, folder: Path) -> dict[Path, Guard]:
    """Return the guard of each F/T sensor with that role, by its shared record in `folder`."""
    several = len(bench.gauges) > 1
    return {
        folder / f"{row.name}.latest": ForceGuard(
            bench.guard_limits(row), row.name if several else ""
        )
        for row in bench.gauges
    }


def guards_of(bench: Bench, folder: Path, *, contact: float = math.inf) -> dict[Path, Guard]:
    """Return all guards of the arm except that of its own motion, by their shared records.

    Args:
        bench: The bench.
        folder: Folder of the shared records.
        contact: Without a gauge, the change of the signal that ends a press, in standard deviations
            of its noise.
    """
    guards = gauge_guards(bench, folder)
    stand_ins, signal, rating = bench.stand_ins, bench.signal, bench.limits.sensor_rating
    if not bench.no_gauge or stand_ins is None or signal is None or rating is None:
        return guards
    guards[folder / f"{signal.name}.signal"] = SignalGuard(
        stand_ins.signal_max,
        stand_ins.stale_signal,
        "px" if signal.kind == "camera" else "counts",
        contact,
    )
    for row in bench.of_kind("arm_wrench"):
        crash = CrashGuard(FRACTION * rating, bench.limits.stale_pose)
        guards[folder / f"{row.name}.latest"] = crash
    return guards
