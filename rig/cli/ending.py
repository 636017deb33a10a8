"""Reports a verb's errors and maps them to exit codes."""

from __future__ import annotations

import argparse
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


def run(parser: argparse.ArgumentParser, argv: Sequence[str]) -> int:
    """Run the verb in `argv`; print an error and return its exit code."""
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
