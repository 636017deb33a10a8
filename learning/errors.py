"""The one error this package raises on purpose."""

from __future__ import annotations


class LearningError(ValueError):
    """What was given cannot be used: the message names file or field, what was found and allowed.

    Sessions and archives that are damaged raise `recorder.SessionError`, which says the same.
    """
