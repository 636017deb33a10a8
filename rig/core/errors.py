"""Errors, grouped by the action they require at the bench, and their exit codes."""

from __future__ import annotations

EXIT_DONE = 0
EXIT_WRONG_INPUT = 2
EXIT_DEVICE_LOST = 3
EXIT_SAFETY_STOP = 4
EXIT_INTERRUPTED = 130


class ConfigError(ValueError):
    """Invalid file or option; the message names file, key, the value found and those allowed."""


class DeviceLost(RuntimeError):
    """The device does not answer, sends garbage or fell silent: check power, cable and address."""


class SafetyStop(RuntimeError):
    """A limit was reached and the arm was halted: inspect the bench before continuing."""
