"""Laws of a diverged simulation: it must report its attempts and its last converged state."""

from __future__ import annotations

import numpy as np

from benchmarks.hard_cases.laws import Law, at_least, at_most
from sim.errors import SimulationDiverged


def evidence(diverged: SimulationDiverged) -> list[Law]:
    """Return the laws of a rejection; the dump is read and removed.

    If the indenter passed through the skin, the waypoint is named and there is no other state.
    """
    if "passes through the skin" in str(diverged):
        return [at_least("names of the waypoint", str(diverged).count("waypoint"), 1)]
    numbers, missing = 0, 1
    if diverged.dump is not None:
        with np.load(diverged.dump) as dump:
            state = {name: dump[name] for name in dump.files}
        diverged.forget_dump()
        missing = len({"scene", "tip", "u", "nodes"} - set(state))
        numbers = int(sum((~np.isfinite(state[name])).sum() for name in ("tip", "u", "nodes")))
    return [
        at_least("attempts listed", len(diverged.tried), 1),
        at_most("missing in the dump", missing, 0),
        at_most("numbers in the dump that are not finite", numbers, 0),
    ]
