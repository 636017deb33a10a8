"""Cost of physical effects, switched off and on.

`python -m benchmarks effects` writes docs/results/effects.md.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from sim.errors import SceneError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "--repeats",
        type=int,
        default=7,
        metavar="N",
        help="pairs of runs, of which times are the minimum (%(default)s)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("docs/results/effects.md"),
        help="page to write (%(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Measure, print results and write the page; return 1 if a disabled effect left a trace.

    Raises:
        SceneError: Fewer than one repeat.
    """
    if options.repeats < 1:
        raise SceneError(f"--repeats: {options.repeats}; allowed: 1 or more")
    with tempfile.TemporaryDirectory() as cache:
        return _run(options, cache)


def _run(options: argparse.Namespace, cache: str) -> int:
    import warp as wp

    from sim.device import ready_device

    # A separate empty cache, because kernels in the usual cache would not be compiled.
    wp.config.kernel_cache_dir = cache
    ready_device("cpu")
    from benchmarks.sim.effects.declaration import EFFECTS
    from benchmarks.sim.effects.measure import combinations, cost
    from benchmarks.sim.effects.page import render

    sets = []
    for one in combinations():
        sets.append(one)
        name = ", ".join(one.key) or "none"
        print(f"{name}: {one.kernels} kernels, {one.own} its own", file=sys.stderr)
    costs = []
    for name in EFFECTS:
        costs.append(cost(name, options.repeats))
        found = costs[-1]
        print(
            f"{name}: off {'leaves no trace' if found.proven else 'LEAVES A TRACE'}, time off "
            f"{found.off_ratio:.3f}, on {found.on_ratio:.2f}; weak: "
            + ", ".join(f"{change:.2e}" for change in found.limits)
        )
    options.out.write_text(render(costs, sets, options.repeats))
    print(f"{options.out}: written")
    return int(not all(found.proven for found in costs))
