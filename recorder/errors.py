"""The one error this package raises on purpose."""


class SessionError(RuntimeError):
    """A session or an archive on disk, or a row offered to one, is not what the format says.

    The message names the place, what was found there and what was expected.
    """
