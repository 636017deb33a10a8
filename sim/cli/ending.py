"""How a verb of the simulator ends: its errors in words, and the exit code that says which."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from sim.cli.options import joined
from sim.errors import SceneError, SimulationDiverged

EXIT_DIVERGED = 1
EXIT_WRONG_INPUT = 2
EXIT_INTERRUPTED = 130

# Last attempts that are told of when there is no solution.
TRIED_SHOWN = 5


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
