"""`python -m benchmarks recording`: measure the cost of recording and write a page."""

from __future__ import annotations

import argparse
from pathlib import Path

from recorder.command_line.errors import EXIT_DONE
from rig.bench.bench import find_bench
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES

_PARTS = ("stores", "cpu", "lateness", "cameras", "full", "alignment")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Measures frames/s, MB/s, CPU share [% of a core], lateness [ms] and the error "
        "of alignment [N, mm, deg, px]. Needs about 16 GB of disk temporarily. Other stores need "
        "the extra `bench`; LeRobot runs in the Python that LEROBOT_PYTHON names."
    )
    parser.add_argument("--quick", action="store_true", help="a minute or two; numbers mean little")
    parser.add_argument(
        "--only",
        action="append",
        choices=_PARTS,
        help="measure this part (may be repeated); the page goes to the terminal unless --out",
    )
    parser.add_argument(
        "--out",
        type=Path,
        help="page to write (default: docs/results/recording.md); charts in images/",
    )
    parser.add_argument(
        "--scratch",
        type=Path,
        default=Path("sessions"),
        help="folder on the disk to measure; all files written there are removed",
    )
    parser.add_argument("--benches", type=Path, default=BENCHES, help="folder of benches")


def run(options: argparse.Namespace) -> int:
    """Measure and write the page; return the exit code.

    Raises:
        ConfigError: Too little disk space, or no bench to collect on.
    """
    from benchmarks.recording import run as cost
    from benchmarks.recording.measure import FULL, QUICK
    from benchmarks.recording.page import criteria_of, render

    scale = QUICK if options.quick else FULL
    bench = find_bench("tacpalm", options.benches) if scale.targets else options.benches
    try:
        options.scratch.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--scratch {options.scratch}: {error.strerror}") from error
    only = options.only or cost.PARTS
    results = cost.measure(scale, options.scratch, bench, only, quick=options.quick)
    for criterion in criteria_of(results):
        print(
            f"{'reached' if criterion.met else 'MISSED ':<8} {criterion.text}: {criterion.measured}"
        )
    # A partial page must not replace the complete one, nor a quick run a full one.
    if options.out is None and (options.only or options.quick):
        print(render(results))
        return EXIT_DONE
    for path in cost.write_page(results, options.out or Path("docs/results/recording.md")):
        print(f"written: {path}")
    return EXIT_DONE
