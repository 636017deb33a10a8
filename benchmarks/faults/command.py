"""Inject every fault into a mock collection and report the reaction of the rig.

`python -m benchmarks faults`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Injects faults into short mock collections, one after the other, and checks "
        "the session of each. Exit code 1 if any row loses samples, hangs or leaves the "
        "arm moving. About half an hour; with --quick, and fewer kills, about ten minutes."
    )
    parser.add_argument(
        "--only",
        action="append",
        metavar="ROW",
        help="run this row only (may be repeated); no page is written unless --out is given; "
        "--list names them",
    )
    parser.add_argument("--list", action="store_true", help="name the rows and end")
    parser.add_argument(
        "--kills", type=int, help="number of kill -9s (default: 100; 10 with --quick)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="each row once, 10 kills in place of 100"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="random seed of the kills (%(default)s)"
    )
    parser.add_argument("--benches", type=Path, default=BENCHES, help="folder of benches")
    parser.add_argument(
        "--out", type=Path, help="page to write (default: docs/results/reliability.md)"
    )
    parser.add_argument(
        "--keep", type=Path, metavar="FOLDER", help="keep sessions and logs of bad rows here"
    )


def run(options: argparse.Namespace) -> int:
    """Run the rows, write the page and return 0, or 1 if any row failed.

    Raises:
        ConfigError: Unknown row, or missing folder of benches.
    """
    from benchmarks.faults.rows import SENSORS
    from benchmarks.faults.run import Campaign, names
    from rig.bench.bench import BenchFile

    if options.list:
        print("\n".join(names()))
        return 0
    unknown = sorted(set(options.only or ()) - set(names()))
    if unknown:
        raise ConfigError(f"--only: found {unknown}; known: {', '.join(names())}")
    for sensor in SENSORS:
        path = options.benches / f"{sensor}.yaml"
        if not BenchFile.read(path).bench.mock:
            raise ConfigError(
                f"{path}: mock: found false; allowed: true: faults go into mock arms only"
            )
    kills = options.kills if options.kills is not None else 10 if options.quick else 100
    if kills < 0:
        raise ConfigError(f"--kills: found {kills}; allowed: 0 or more")
    out = options.out or (None if options.only else Path("docs/results/reliability.md"))
    campaign = Campaign(
        options.benches,
        only=tuple(options.only or names()),
        kills=kills,
        seed=options.seed,
        keep=options.keep,
    )
    return 0 if campaign.run(out) else 1
