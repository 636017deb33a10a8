"""Run a subcommand, print its errors and map them to exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from sim.cli.options import joined
from sim.errors import SceneError, SimulationDiverged

EXIT_DIVERGED = 1
EXIT_WRONG_INPUT = 2
EXIT_INTERRUPTED = 130

# Most recent attempts that are listed when there is no solution.
TRIED_SHOWN = 5


def run(parser: argparse.ArgumentParser, argv: Sequence[str]) -> int:
    """Run the subcommand that `argv` names, print any error and return the exit code."""
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
