"""Exit codes, and the base of errors that end a command with one line."""

from __future__ import annotations

EXIT_DONE = 0
EXIT_WRONG_INPUT = 2
EXIT_DEVICE_LOST = 3
EXIT_SAFETY_STOP = 4
EXIT_INTERRUPTED = 130
# As a shell reports a process that SIGPIPE has ended.
EXIT_BROKEN_PIPE = 141


class CommandError(Exception):
    """An error that a person can act on; others are faults of the program and show a traceback."""

    exit_code = EXIT_WRONG_INPUT
    label = "wrong input"

    def report(self) -> str:
        """Return the text that the command prints before it ends with `exit_code`."""
        return f"{self.label}: {self}"
