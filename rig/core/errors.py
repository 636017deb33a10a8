"""Errors, grouped by the action they require at the bench."""

from __future__ import annotations

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_SAFETY_STOP, CommandError


class ConfigError(CommandError, ValueError):
    """Invalid file or option; the message names file, key, the value found and those allowed."""


class DeviceLost(CommandError, RuntimeError):
    """The device does not answer, sends garbage or fell silent: check power, cable and address."""

    exit_code = EXIT_DEVICE_LOST

    def report(self) -> str:
        """Return the line of a command that had not begun to record."""
        return f"device lost: {self}; nothing was recorded"


class SafetyStop(CommandError, RuntimeError):
    """A limit was reached and the arm was halted: inspect the bench before continuing."""

    exit_code = EXIT_SAFETY_STOP

    def report(self) -> str:
        """Return the line of a command that had not begun to record."""
        return f"safety stop: {self}; nothing was recorded"
