"""Exit codes, the base of errors that end a command with one line, and the end of a command."""

import errno
import os
import sys

from recorder.command_line.terminal import paint

EXIT_DONE = 0
EXIT_WRONG_INPUT = 2
EXIT_DEVICE_LOST = 3
EXIT_SAFETY_STOP = 4
EXIT_INTERRUPTED = 130
# As a shell reports a process that SIGPIPE has ended.
EXIT_BROKEN_PIPE = 141
# Cures of errors of the file system.
_CURES = {
    errno.EROFS: "mounted read-only: name a folder on another disk",
    errno.EACCES: "name a folder of your own, or get the right to write here",
    errno.EPERM: "name a folder of your own, or get the right to write here",
    errno.ENOSPC: "make room on this disk, or name a folder on another",
    errno.EDQUOT: "make room in your quota, or name a folder on another disk",
}
# File descriptor of standard output.
_STDOUT = 1


class CommandError(Exception):
    """An error that a person can act on; others are faults of the program and show a traceback."""

    exit_code = EXIT_WRONG_INPUT
    label = "wrong input"

    def report(self) -> str:
        """Return the text that the command prints before it ends with `exit_code`."""
        return f"{self.label}: {self}"


def failure(error: BaseException, interrupted: str = "") -> int:
    """Print the line of a known error or of Ctrl-C, and return the exit code of the command.

    An error that is a fault of the program is raised again; `interrupted` is what Ctrl-C leads to.
    """
    if isinstance(error, CommandError):
        line, code = error.report(), error.exit_code
    elif isinstance(error, OSError):
        if _nobody_reads(error):
            return EXIT_BROKEN_PIPE
        reason = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        cure = _CURES.get(error.errno or 0)
        line = f"cannot read or write: {reason}" + (f"; {cure}" if cure else "")
        code = EXIT_WRONG_INPUT
    elif isinstance(error, KeyboardInterrupt):
        line, code = "; ".join(filter(None, ["interrupted", interrupted])), EXIT_INTERRUPTED
    else:
        raise error
    # Names that were typed or read may hold codes that a terminal obeys.
    line = "".join(
        each if each.isprintable() or each == "\n" else repr(each)[1:-1] for each in line
    )
    label, colon, rest = line.partition(":")
    print(paint(label, "fault", sys.stderr) + colon + rest, file=sys.stderr)
    return code


def _nobody_reads(error: OSError) -> bool:
    """Return True if standard output is a pipe that nobody reads any more, such as `| head`.

    Other broken pipes are errors. Python would fail again at its exit, so output is discarded.
    """
    import select

    events = select.poll()
    events.register(_STDOUT, 0)
    if not isinstance(error, BrokenPipeError) or not events.poll(0):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), _STDOUT)
    return True
