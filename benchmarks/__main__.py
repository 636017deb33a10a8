"""Command line of the benchmarks: `python -m benchmarks NAME [options]`, from the repository."""

import sys
from collections.abc import Sequence

from recorder.command_line.errors import EXIT_WRONG_INPUT
from tactile.run import HELP, ended, run_module

# The module of each benchmark, and its line of help.
BENCHMARKS = {
    # Recording
    "recording": ("benchmarks.recording.command", "what recording costs, loses and gives back"),
    "faults": ("benchmarks.faults.command", "faults, kills, wrong benches, endurance"),
    "first-hour": ("benchmarks.first_hour", "every command from the wheel to live forces"),
    # The simulator
    "hard-cases": ("benchmarks.hard_cases.command", "scenes that break simulators; finer meshes"),
    "accuracy": ("benchmarks.accuracy.command", "what accuracy costs in time"),
    "independent": ("benchmarks.independent.command", "forces beside solutions by other methods"),
    "twin": ("benchmarks.twin.command", "twins of sensors: skins, labels, rows, live forces"),
    # Learning
    "paper": ("benchmarks.paper.command", "the paper's models trained from nothing"),
    "slip": ("benchmarks.slip", "slips that are noticed, and alarms without slip"),
    "gauge": ("benchmarks.gauge.command", "forces without a gauge, from the weakest way"),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark and return its exit code."""
    name, *options = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in HELP:
        return ended(_list)
    if name not in BENCHMARKS:
        print(f"wrong input: {name!r}; allowed: {', '.join(BENCHMARKS)}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    return run_module(
        BENCHMARKS[name][0],
        options,
        prog=f"python -m benchmarks {name}",
        interrupted="again, it goes on where it was; --draw shows the complete parts",
    )


def _list() -> int:
    width = max(map(len, BENCHMARKS))
    print("usage: python -m benchmarks NAME [options]; NAME --help has them\n")
    for name, (_, text) in BENCHMARKS.items():
        print(f"  {name:{width}}  {text}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
