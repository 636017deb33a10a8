"""`tactile sample`: record a short session of each kind of sensor on mock benches."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from recorder.command_line.errors import CommandError

# A sensor of each kind: a flat gel seen by a camera, a dome seen by a camera, an array of taxels.
SENSORS = ("gelsight", "tacpalm", "uskin")
# Predicted duration of a session [s].
SECONDS = 20.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        f"Records sessions of about {SECONDS:g} s on the packaged mock benches "
        f"{', '.join(SENSORS)}, each with its card (NAME.md) and contact sheet. No arm moves. They "
        "are for trying things out: emulated sensors are no data to train for real ones."
    )
    parser.add_argument(
        "--out", type=Path, default=Path("samples"), metavar="DIR", help="(%(default)s)"
    )
    parser.add_argument(
        "--sensor", choices=SENSORS, action="append", help="this one alone; may be repeated"
    )


def run(options: argparse.Namespace) -> int:
    """Record the samples; return the exit code of the first collection that fails.

    Raises:
        CommandError: A sample exists.
    """
    from recorder.command_line.run import main
    from rig.acquire.collector import seconds_per_target
    from rig.bench.bench import BenchFile
    from rig.core.packaged import BENCHES
    from tactile.card import page

    sessions = {name: options.out / f"{name}.zarr" for name in options.sensor or SENSORS}
    for path in sessions.values():
        if path.exists():
            raise CommandError(f"{path}: exists; allowed: a new --out DIR, or delete it")
    options.out.mkdir(parents=True, exist_ok=True)
    for name, path in sessions.items():
        # The packaged file itself: a lab bench of the same name would move its arm.
        bench_path = BENCHES / f"{name}.yaml"
        bench = BenchFile.read(bench_path).bench
        count = math.ceil(SECONDS / seconds_per_target(bench, bench.trajectory))
        words = ["--bench", str(bench_path), "--targets", str(count)]
        if code := main(["collect", *words, "--out", str(path)], "rig"):
            return code
        path.with_suffix(".md").write_text(page(path))
        print(f"{path.with_suffix('.md')}: card of {path}")
    return 0
