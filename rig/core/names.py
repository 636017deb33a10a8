"""Names: of the operator, and errors for names that nothing has, with the likely one."""

import difflib
import getpass
import os
from collections.abc import Iterable

from rig.core.errors import ConfigError


def operator_name(named: str) -> str:
    """Return `named`, or without it the login name, or the number of a user who has no name."""
    try:
        return named or getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"


def plain_name(where: str, name: str) -> str:
    """Return a name at an option or key `where` after checking that it is a plain word.

    Raises:
        ConfigError: Not printable, a path, or like an option.
    """
    if not name.isprintable() or not name or name.startswith(("-", ".")) or "/" in name:
        raise ConfigError(
            f"{where}: found {name!r}; allowed: printable letters, digits and signs, no / and "
            "neither - nor . in front"
        )
    return name


def unknown_name(where: str, found: str, known: Iterable[str], places: str = "") -> ConfigError:
    """Return the error for a name at an option or key `where`; the known ones are in `places`."""
    names = sorted(known)
    by_folded = {name.casefold(): name for name in names}
    likely = difflib.get_close_matches(found.casefold(), by_folded, n=1)
    meant = f"did you mean {by_folded[likely[0]]}? " if likely else ""
    return ConfigError(
        f"{where}: found {found!r}; {meant}known{places and ' '}{places}: {', '.join(names)}"
    )
