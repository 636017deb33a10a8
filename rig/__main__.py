"""Command line of the rig: `python -m rig VERB`; each verb is a module of `rig.cli`."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from rig.cli.ending import run
from rig.core.errors import EXIT_WRONG_INPUT

_COMMANDS = (
    "collect",
    "home",
    "calibrate-latency",
    "force-depth",
    "campaign",
    "jog",
    "live",
    "grip",
    "preview",
    "compare",
    "mock",
    "replay",
)


def _arguments(words: Sequence[str]) -> argparse.ArgumentParser:
    """Return the parser of the verb in `words` (importing only its module), else of all verbs."""
    parser = argparse.ArgumentParser(prog="python -m rig", description="The tactile bench.")
    subcommands = parser.add_subparsers(dest="verb", required=True)
    chosen: Sequence[str] = _COMMANDS
    if words and words[0] in _COMMANDS:
        chosen = words[:1]
        # The usage line still lists all verbs.
        subcommands.metavar = f"{{{','.join(_COMMANDS)}}}"
    for verb in chosen:
        importlib.import_module(f"rig.cli.{verb.replace('-', '_')}").add_to(subcommands)
    return parser


# Verbs that became benchmarks, and the name of the benchmark.
_MOVED = {"bench-recorder": "recording", "endurance": "endurance", "faults": "faults"}


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return the exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words and words[0] in _MOVED:
        now = f"python -m benchmarks {_MOVED[words[0]]}"
        print(
            f"wrong input: {words[0]!r} has moved; run, from the repository: {now}", file=sys.stderr
        )
        return EXIT_WRONG_INPUT
    return run(_arguments(words), words)


if __name__ == "__main__":
    sys.exit(main())
