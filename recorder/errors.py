"""The one error this package raises on purpose."""


class SessionError(RuntimeError):
    """A session on disk, or a row offered to it, is not what the format says.

    The message names the place, what was found there and what was expected.
    """
