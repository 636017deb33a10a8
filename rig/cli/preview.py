"""`python -m rig preview`: draw the plan and check it against the bench's limits."""

from __future__ import annotations

import argparse
from pathlib import Path

from rig.bench.bench import BenchFile
from rig.cli.options import bench_options, bench_path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser)
    parser.add_argument("--out", type=Path, help="PNG to write (default: in sessions/)")


def run(options: argparse.Namespace) -> int:
    """Draw and check the plan; return the exit code."""
    from rig.acquire.preview import preview

    bench = BenchFile.read(bench_path(options)).bench
    picture = options.out or Path("sessions") / f"{bench.sensor}-plan.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    return preview(bench, picture)
