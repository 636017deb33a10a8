"""`python -m benchmarks endurance`: memory and losses of a long mock collection."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from recorder.progress import Progress
from rig.cli.options import bench_options, bench_path
from rig.core.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser)
    parser.add_argument(
        "--minutes", type=float, default=30.0, help="minimum length of the plan [min] (%(default)s)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("docs/results/endurance.md"),
        help="page to write (%(default)s)",
    )
    parser.add_argument("--session", type=Path, help="keep the session here (default: deleted)")


def run(options: argparse.Namespace) -> int:
    """Run, write the page and return the collection's exit code.

    Raises:
        ConfigError: Not a mock bench, or `--minutes` exceeds the longest plan.
    """
    from benchmarks.endurance.long_run import long_bench, run_long
    from benchmarks.endurance.report import page

    if not options.minutes > 0:
        raise ConfigError(f"--minutes: found {options.minutes:g}; allowed: above 0")
    seconds = 60 * options.minutes
    with tempfile.TemporaryDirectory(prefix="tactile-rig-") as scratch:
        folder = Path(scratch)
        bench_file, targets = long_bench(bench_path(options), seconds, folder)
        session = options.session or folder / "long.zarr"
        print(f"{targets} targets, at least {options.minutes:g} minutes", flush=True)
        with Progress("endurance", sys.stderr) as progress:
            found = run_long(
                bench_file, session, targets, lambda so_far: progress(min(so_far / seconds, 1.0))
            )
        print(found.output)
        if found.exit_code == 0:
            options.out.write_text(page(found))
            print(f"{options.out}: written")
        return found.exit_code
