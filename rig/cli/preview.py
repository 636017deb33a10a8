"""`python -m rig preview`: draw the plan and check it against the bench's limits."""

from __future__ import annotations

import argparse
from pathlib import Path

from rig.bench.bench import load_bench
from rig.cli.options import bench_options, bench_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser)
    parser.add_argument("--out", type=Path, help="PNG to write (default: in sessions/)")


def run(options: argparse.Namespace) -> int:
    """Draw and check the plan; return the exit code."""
    from rig.acquire.preview import preview

    bench, _ = load_bench(bench_path(options))
    picture = options.out or Path("sessions") / f"{bench.sensor}-plan.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    return preview(bench, picture)
