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


def unknown_name(where: str, found: str, known: Iterable[str], places: str = "") -> ConfigError:
    """Return the error for a name at an option or key `where`; the known ones are in `places`."""
    names = sorted(known)
    by_folded = {name.casefold(): name for name in names}
    likely = difflib.get_close_matches(found.casefold(), by_folded, n=1)
    meant = f"did you mean {by_folded[likely[0]]}? " if likely else ""
    return ConfigError(
        f"{where}: found {found!r}; {meant}known{places and ' '}{places}: {', '.join(names)}"
    )
