"""Errors, grouped by the action they require at the bench."""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_SAFETY_STOP, CommandError
from recorder.errors import SessionError

_T = TypeVar("_T")


class ConfigError(CommandError, ValueError):
    """Invalid file or option; the message names file, key, the value found and those allowed."""


class DeviceLost(CommandError, RuntimeError):
    """The device does not answer, sends garbage or fell silent: check power, cable and address.

    Its message is `where: problem; what to check`.
    """

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


def combined(failures: Sequence[Exception]) -> Exception:
    """Return the only failure, or one error of the first one's type that names them all."""
    each: list[Exception] = [
        one for failure in failures for one in getattr(failure, "failures", (failure,))
    ]
    if len(each) == 1:
        return each[0]
    lines = "".join(f"\n  {failure}" for failure in each)
    error = type(each[0])(f"{len(each)} devices:{lines}\n")
    error.failures = tuple(each)  # type: ignore[attr-defined]
    return error


def all_opened(opens: Mapping[str, Callable[[], _T]]) -> dict[str, _T]:
    """Return what opening each device returns, by name; all are tried before errors are raised."""
    opened: dict[str, _T] = {}
    failures: list[Exception] = []
    for name, open_device in opens.items():
        try:
            opened[name] = open_device()
        except (ConfigError, DeviceLost, SessionError) as error:
            failures.append(error)
    if failures:
        raise combined(failures)
    return opened
