"""Errors of the simulator: an invalid scene, and a solution that was not found."""

import math
from dataclasses import fields
from numbers import Real
from pathlib import Path
from typing import Any

from recorder.command_line.errors import CommandError

# Most recent attempts that are listed when there is no solution.
TRIED_SHOWN = 5


class SceneError(CommandError, ValueError):
    """Scene that is not physical or not solvable; the message has field, value, allowed values."""


class SimulationDiverged(CommandError, RuntimeError):
    """No converged state was found, even with the smallest step; nothing unconverged is returned.

    `tried` lists the attempts (step, iterations, residual); `dump` is the `.npz` with the last
    converged state and the scene, or None if it could not be written. `reached` is the `Result` up
    to the last waypoint that has a solution, or None if there is none beyond the first.
    """

    exit_code = 1
    reached: Any = None

    def __init__(self, message: str, tried: tuple[str, ...] = (), dump: Path | None = None) -> None:
        super().__init__(message)
        self.tried = tried
        self.dump = dump

    @property
    def reason(self) -> str:
        """The message without the place of the dump."""
        return str(self).partition("; state: ")[0]

    def forget_dump(self) -> None:
        """Remove the dump and its folder, as another attempt follows."""
        if self.dump is not None:
            self.dump.unlink(missing_ok=True)
            self.dump.parent.rmdir()

    def report(self) -> str:
        """Return the message and the most recent attempts."""
        tried = [f"  tried: {attempt}" for attempt in self.tried[-TRIED_SHOWN:]]
        return "\n".join([f"no solution: {self}", *tried])


class PassesThrough(SimulationDiverged):
    """The indenter stands in the skin: the mesh does not resolve the contact, a finer one may."""


# Checks of fields, with messages of one form.


def plain(value: Any) -> Any:
    """Return NumPy's numbers as Python's, and lists and arrays as tuples; all else as it is."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    return tuple(map(plain, value)) if isinstance(value, list | tuple) else value


def make_plain(owner: Any) -> None:
    """Apply `plain` to the fields of a frozen dataclass, as its construction begins."""
    for each in fields(owner):
        if each.init:
            object.__setattr__(owner, each.name, plain(getattr(owner, each.name)))


def check_range(
    owner: str,
    name: str,
    value: float,
    low: float,
    high: float,
    *,
    unit: str = "",
    open_low: bool = False,
) -> None:
    """Reject a number that is not finite or not within `low` to `high`."""
    value = plain(value)
    inside = is_finite(value) and low <= value <= high
    if not inside or (open_low and value == low):
        unit = f" {unit}" if unit else ""
        edge = "above " if open_low else ""
        raise SceneError(
            f"{owner}.{name}: {value!r}{unit}; allowed: {edge}{low:g} to {high:g}{unit}"
        )


def is_finite(value: Any) -> bool:
    """True for a number that is neither infinite nor NaN."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def check_choice(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Reject a value that is none of the allowed ones."""
    if value not in allowed:
        raise SceneError(f"{name}: {value!r}; allowed: {', '.join(map(repr, allowed))}")


def check_kind(name: str, value: Any, kind: Any, allowed: str, *, optional: bool = False) -> None:
    """Reject a value that is not of `kind`; with `optional`, None is accepted."""
    if not (isinstance(value, kind) or (optional and value is None)):
        none = ", or None" if optional else ""
        raise SceneError(f"{name}: {value!r}; allowed: {allowed}{none}")
