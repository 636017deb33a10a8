"""The one error this package raises on purpose."""

from recorder.command_line.errors import CommandError


class LearningError(CommandError, ValueError):
    """Invalid input; the message names the file or field, its value and the allowed values.

    Corrupt sessions and archives raise `recorder.SessionError`, whose messages have the same form.
    """
