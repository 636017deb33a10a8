"""Command line of the simulator: `python -m sim VERB`; each verb is a module of `sim.cli`."""

from __future__ import annotations

import argparse
import sys

from sim.cli import archive, hold, loop, press
from sim.cli.ending import EXIT_WRONG_INPUT, run

_COMMANDS = (press, loop, hold, archive)


def arguments() -> argparse.ArgumentParser:
    """Return the parser of all verbs and their options."""
    parser = argparse.ArgumentParser(
        prog="python -m sim",
        description="Presses rigid indenters into a soft layer. Lengths in mm, forces in N.",
    )
    subcommands = parser.add_subparsers(dest="verb", required=True)
    for verb in _COMMANDS:
        verb.add_to(subcommands)
    return parser


# Verbs of earlier versions; each is now a benchmark of the same name.
_MOVED = ("refine", "hard-cases", "effects", "accuracy", "speed")


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return its exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words and words[0] in _MOVED:
        now = f"python -m benchmarks {words[0]}"
        print(
            f"wrong input: {words[0]!r} has moved; run, from the repository: {now}", file=sys.stderr
        )
        return EXIT_WRONG_INPUT
    return run(arguments(), words)


if __name__ == "__main__":
    sys.exit(main())
