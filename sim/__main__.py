"""Command line of the simulator: `python -m sim VERB`; every verb is a file of `sim.cli`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from sim.cli import archive, hold, loop, press
from sim.cli.options import joined
from sim.errors import SceneError, SimulationDiverged

EXIT_DIVERGED = 1
EXIT_WRONG_INPUT = 2
EXIT_INTERRUPTED = 130

TRIED_SHOWN = 5
"""Last attempts that are told of when there is no solution."""

_VERBS = (press, loop, hold, archive)


def arguments() -> argparse.ArgumentParser:
    """The parser of every verb and its options."""
    parser = argparse.ArgumentParser(
        prog="python -m sim",
        description="Presses rigid indenters into a soft layer. Lengths in mm, forces in N.",
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in _VERBS:
        verb.add_to(verbs)
    return parser


_MOVED = ("refine", "hard-cases", "effects", "accuracy", "cost-table", "speed")
"""Verbs that measured; each is a benchmark of the same name now."""


def main(argv: list[str] | None = None) -> int:
    """Run one verb; the exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words and words[0] in _MOVED:
        now = f"python -m benchmarks {words[0]}"
        print(
            f"wrong input: {words[0]!r} has moved; run, from the repository: {now}", file=sys.stderr
        )
        return EXIT_WRONG_INPUT
    return run(arguments(), words)


def run(parser: argparse.ArgumentParser, argv: Sequence[str]) -> int:
    """Run the verb that `argv` names; errors are printed, the exit code says which they are."""
    options = parser.parse_args(joined(argv))
    try:
        return int(options.run(options))
    except SceneError as error:
        print(f"wrong input: {error}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except SimulationDiverged as error:
        print(f"no solution: {error}", file=sys.stderr)
        for attempt in error.tried[-TRIED_SHOWN:]:
            print(f"  tried: {attempt}", file=sys.stderr)
        return EXIT_DIVERGED
    except OSError as error:
        print(f"cannot read or write: {error}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except KeyboardInterrupt:
        print("interrupted; nothing was written", file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
