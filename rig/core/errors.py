"""Errors by what the person at the bench can do about them, and the exit code of each."""

from __future__ import annotations

EXIT_DONE = 0
EXIT_WRONG_INPUT = 2
EXIT_DEVICE_LOST = 3
EXIT_SAFETY_STOP = 4
EXIT_INTERRUPTED = 130


class ConfigError(ValueError):
    """A file or an option is wrong: the message names file, key, what was found and allowed."""


class DeviceLost(RuntimeError):
    """A device does not answer, answers garbage, or fell silent: check power, cable, address."""


class SafetyStop(RuntimeError):
    """A limit was reached and the arm was halted: look at the bench before going on."""
