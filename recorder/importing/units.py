"""Names of force and torque columns and their units, read strictly: nothing is guessed."""

import re

from recorder.errors import SessionError

FORCE_UNITS = {
    "N": 1.0,
    "mN": 1e-3,
    "kN": 1e3,
    "gf": 9.80665e-3,
    "kgf": 9.80665,
    "lbf": 4.4482216152605,
}
"""Newton per unit."""
TORQUE_UNITS = {
    "N m": 1.0,
    "N mm": 1e-3,
    "mN m": 1e-3,
    "kgf cm": 9.80665e-2,
    "lbf in": 0.1129848290276167,
}
"""Newton metre per unit."""
TIME_UNITS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
"""Nanoseconds per unit."""
AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")

_COLUMN = re.compile(
    r"^(?P<name>[A-Za-z]+)(?:\s*[(\[]\s*(?P<unit>[^)\]]+?)\s*[)\]]|_(?P<tail>\w+))?$"
)
_TIMES = ("t", "time", "timestamp")


def parse_unit(text: str, known: dict[str, float], where: str) -> float:
    """Return the factor to SI of a unit, however its parts are set apart (`N-mm`, `Nmm`, `N*mm`).

    Raises:
        SessionError: Not among `known`.
    """
    plain = re.sub(r"[\s\-*·.]", "", text)
    for name, factor in known.items():
        if plain == name.replace(" ", ""):
            return factor
    raise SessionError(f"{where}: found unit {text!r}; allowed: {', '.join(known)}")


def parse_header(
    names: list[str], *, force: str | None, torque: str | None, ignore: tuple[str, ...], where: str
) -> list[tuple[str, float] | None]:
    """Return, for each column, its axis (or `t`) and its factor; None for one to ignore.

    Args:
        names: As in the file, such as `Fx (N)`, `Tz[N mm]`, `time_ms`.
        force: Unit of force columns that do not say it.
        torque: The same for torque columns.
        ignore: Names of columns to leave out.
        where: The file, for errors.

    Raises:
        SessionError: A column that is not known, comes twice, or does not say its unit.
    """
    found: list[tuple[str, float] | None] = []
    for raw in names:
        name = raw.strip().lstrip("\ufeff").strip("'\"# ")
        if name in ignore:
            found.append(None)
            continue
        found.append(_column(name, force, torque, f"{where}: column {name!r}"))
    kept = [column[0] for column in found if column is not None]
    twice = sorted({name for name in kept if kept.count(name) > 1})
    if twice:
        raise SessionError(f"{where}: column {twice[0]} comes twice")
    if not set(kept) & set(AXES):
        raise SessionError(f"{where}: no force column; known: {', '.join(AXES)}")
    return found


def _column(name: str, force: str | None, torque: str | None, where: str) -> tuple[str, float]:
    match = _COLUMN.match(name)
    word = match["name"].lower() if match else ""
    unit = (match["unit"] or match["tail"]) if match else None
    if word in _TIMES:
        if unit is None:
            raise SessionError(f"{where}: says no unit; name it such as {name}_s or {name} (ms)")
        return "t", parse_unit(unit, TIME_UNITS, where)
    for axis in AXES:
        if word != axis.lower():
            continue
        known, default, option = (
            (FORCE_UNITS, force, "--units")
            if axis[0] == "F"
            else (TORQUE_UNITS, torque, "--torque-units")
        )
        if unit is None and default is None:
            raise SessionError(f"{where}: says no unit; say {option} ({', '.join(known)})")
        return axis, parse_unit(unit or default or "", known, where)
    raise SessionError(
        f"{where}: not known; allowed: {', '.join(AXES)}, each with its unit, as Fx (N), and "
        f"{', '.join(_TIMES)} with theirs; leave others out with --ignore NAME"
    )
