"""The only error that this package raises deliberately."""

from recorder.command_line.errors import CommandError


class SessionError(CommandError, RuntimeError):
    """Raised for a session, an archive or a row to be written that violates the format.

    The message names the location, the value found and the value expected.
    """
