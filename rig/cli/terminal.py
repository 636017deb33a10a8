"""Questions on the terminal of a bench. Only what is typed after a question answers it."""

from __future__ import annotations

import select
import sys
import termios

from rig.acquire.control import Interrupted
from rig.core.errors import ConfigError


def require_terminal() -> None:
    """Reject a bench that will ask before it moves, if there is no terminal to ask on."""
    if not sys.stdin.isatty():
        raise ConfigError("lab bench: no terminal to ask on; allowed: a terminal at the bench")


def answer(question: str) -> str | None:
    """Return the line that is typed after the question has appeared, without its end.

    What was typed before is dropped: an Enter meant for an earlier command must not start an arm.

    Returns:
        The line; None at the end of input.
    """
    if sys.stdin.isatty():
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    print(question, end="", flush=True)
    # Ctrl-C may come as soon as the question appears; `input` misses one just before it reads.
    while not select.select([sys.stdin], [], [], 0.2)[0]:
        pass
    line = sys.stdin.readline()
    return line.removesuffix("\n") if line else None


def confirm(lines: list[str], word: str = "move") -> None:
    """Print what will happen, and wait until `word` is typed on this terminal."""
    print("\n".join(lines), flush=True)
    require_terminal()
    try:
        typed = answer(f'type "{word}" and Enter to start, anything else to stop: ')
    except KeyboardInterrupt:
        typed = None
    if typed != word:
        print()
        raise Interrupted(f'the answer was not "{word}"')
