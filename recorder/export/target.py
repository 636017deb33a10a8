"""Where an export goes: built beside, renamed when whole; and names that cannot leave it."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from recorder.durable import sync_directory
from recorder.errors import SessionError

CREATING = ".creating"
"""Suffix of an export that is being built and means nothing yet."""
_LONGEST = 80


@contextmanager
def building(destination: str | os.PathLike[str]) -> Iterator[Path]:
    """Give the path to build at; on leaving, give it its name, or remove it after an error.

    An interruption counts as an error: there is a whole export, or none.

    Raises:
        SessionError: Something is at the destination, or its folder does not exist.
    """
    final = Path(destination)
    if final.exists() or final.is_symlink():
        raise SessionError(f"{final}: exists already")
    if not final.parent.is_dir():
        raise SessionError(f"{final.parent}: no such directory")
    beside = final.with_name(final.name + CREATING)
    _remove(beside)
    try:
        yield beside
        beside.rename(final)
        sync_directory(final.parent)
    except BaseException:
        _remove(beside)
        raise


def file_name(text: object) -> str:
    """Return a text as a file name: one component, letters, digits, dot, dash and underscore.

    `../x` becomes `_x`, an empty text `unnamed`: no name leads out of the folder it is put in.
    """
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", str(text)).lstrip(".")
    return plain[:_LONGEST] or "unnamed"


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
