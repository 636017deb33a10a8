"""Command line of the rig: `python -m rig VERB`; every verb is a file of `rig.cli`."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

from recorder import SessionError
from rig.acquire.control import Interrupted
from rig.core.errors import (
    EXIT_DEVICE_LOST,
    EXIT_INTERRUPTED,
    EXIT_SAFETY_STOP,
    EXIT_WRONG_INPUT,
    ConfigError,
    DeviceLost,
    SafetyStop,
)

_VERBS = (
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
    """The options of the verb in `words`, of which alone the module is loaded; else of all."""
    parser = argparse.ArgumentParser(prog="python -m rig", description="The tactile bench.")
    verbs = parser.add_subparsers(dest="verb", required=True)
    chosen: Sequence[str] = _VERBS
    if words and words[0] in _VERBS:
        chosen = words[:1]
        # The usage line names all of them none the less.
        verbs.metavar = f"{{{','.join(_VERBS)}}}"
    for verb in chosen:
        importlib.import_module(f"rig.cli.{verb.replace('-', '_')}").add_to(verbs)
    return parser


_MOVED = {"bench-recorder": "recording", "endurance": "endurance", "faults": "faults"}
"""Verbs that measured, and the benchmark that each is now."""


def main(argv: list[str] | None = None) -> int:
    """Run one verb; the exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words and words[0] in _MOVED:
        now = f"python -m benchmarks {_MOVED[words[0]]}"
        print(
            f"wrong input: {words[0]!r} has moved; run, from the repository: {now}", file=sys.stderr
        )
        return EXIT_WRONG_INPUT
    return run(_arguments(words), words)


def run(parser: argparse.ArgumentParser, argv: Sequence[str]) -> int:
    """Run the verb that `argv` names; errors are printed, the exit code says which they are."""
    options = parser.parse_args(argv)
    try:
        return int(options.run(options))
    except ConfigError as error:
        print(f"wrong input: {error}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except DeviceLost as error:
        print(f"device lost: {error}; nothing was recorded", file=sys.stderr)
        return EXIT_DEVICE_LOST
    except SafetyStop as error:
        print(f"safety stop: {error}; nothing was recorded", file=sys.stderr)
        return EXIT_SAFETY_STOP
    except SessionError as error:
        print(f"session: {error}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except (KeyboardInterrupt, Interrupted):
        print("interrupted; nothing was recorded", file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
