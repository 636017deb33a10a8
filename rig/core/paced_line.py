"""A line that is rewritten in place on a terminal, and written at longer intervals elsewhere."""

from collections.abc import Callable
from typing import TextIO

from recorder.command_line.terminal import line_of, width_of

_CLEAR = "\x1b[K"


class PacedLine:
    """The newest text, as often as it can be read: at these intervals on a terminal, or elsewhere.

    `elsewhere` is called with a text if the output is no terminal, or a terminal that is gone.
    """

    def __init__(
        self, out: TextIO, terminal_ns: int, elsewhere_ns: int, elsewhere: Callable[[str], object]
    ) -> None:
        self._out, self._elsewhere = out, elsewhere
        self._terminal_ns, self._elsewhere_ns = terminal_ns, elsewhere_ns
        self._is_terminal = out.isatty()
        self._due_ns = 0
        self._is_open = False

    def is_due(self, now_ns: int) -> bool:
        """Return True if a text is to be shown at `now_ns`; the next is due an interval later."""
        if now_ns < self._due_ns:
            return False
        self._due_ns = now_ns + (self._terminal_ns if self._is_terminal else self._elsewhere_ns)
        return True

    def hurry(self) -> None:
        """Make the next text due at once."""
        self._due_ns = 0

    def show(self, *parts: str) -> None:
        """Show the parts of a text that are not empty; on a terminal, those that a row holds."""
        if self._is_terminal:
            self._is_open = True
            # A full row would wrap on some terminals.
            self._write(f"\r{line_of(parts, (width_of(self._out) or 80) - 1)}{_CLEAR}")
        else:
            self._elsewhere(line_of(parts, None))

    def end(self) -> None:
        """End the line and leave it on the terminal; may be called twice."""
        if self._is_open and self._is_terminal:
            self._write("\n")
        self._is_open = False

    def _write(self, text: str) -> None:
        try:
            self._out.write(text)
            self._out.flush()
        except OSError:
            self._is_terminal = False
