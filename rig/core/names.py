"""Errors for names that nothing has: the likely name, and all names that are allowed."""

import difflib
from collections.abc import Iterable

from rig.core.errors import ConfigError


def unknown_name(where: str, found: str, known: Iterable[str], places: str = "") -> ConfigError:
    """Return the error for a name that is not known.

    Args:
        where: Option or key that has the name.
        found: The name.
        known: Names that are allowed.
        places: Where those are found, such as `in benches/`.
    """
    names = sorted(known)
    by_folded = {name.casefold(): name for name in names}
    likely = difflib.get_close_matches(found.casefold(), by_folded, n=1)
    meant = f"did you mean {by_folded[likely[0]]}? " if likely else ""
    return ConfigError(
        f"{where}: found {found!r}; {meant}known{places and ' '}{places}: {', '.join(names)}"
    )
