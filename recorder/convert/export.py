"""The one call behind `python -m recorder export`."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from recorder.errors import SessionError
from recorder.session.reader import Session
from recorder.store.durable import sync_directory

# What the person who exports may choose, and how a format reports how far it is.

# Called with the rows done and those to do.
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Options:
    """Choices; a format ignores those that do not concern it."""

    decode: bool = False
    """hdf5: store images as pixels instead of the camera's own JPEG bytes."""
    valid_only: bool = False
    """lerobot, genforce: leave out rows that lack a sample near enough."""


def ignored(done: int, total: int) -> None:
    """Report to nobody."""


# Where an export goes: built beside, renamed when whole; and names that cannot leave it.

# Suffix of an export that is being built and means nothing yet.
CREATING = ".creating"
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


# What can be written, and what it is.
FORMATS: Mapping[str, str] = {
    "lerobot": "LeRobot dataset v3.0, one episode per target (a folder)",
    "mcap": "MCAP with Foxglove's schemas, every sample at its own time (a file)",
    "hdf5": "HDF5, the whole session with names, types and attributes (a file)",
    "genforce": "the folders of the GenForce recordings, four phases per point (a folder)",
}


def export(
    source: Session | str | os.PathLike[str],
    destination: str | os.PathLike[str],
    to: str,
    *,
    options: Options | None = None,
    progress: Progress | None = None,
) -> None:
    """Write a finished session in another format. The source is only read.

    The destination appears whole or not at all. Rows are streamed: memory does not grow with the
    length of the session, but for the frames view (up to 0.6 kB a row) and the times.

    Args:
        source: A session, its path, or the URL of one.
        destination: File or folder to make; nothing may be there yet.
        to: One of `FORMATS`.
        options: Choices of the format.
        progress: Called with the rows done and those to do.

    Raises:
        SessionError: An unknown format, an unfinished or damaged source, an existing destination,
            a missing library, or a session that the format cannot hold.
        OSError: The disk is full, or not writable.
    """
    if to not in FORMATS:
        raise SessionError(f"found format {to!r}; known: {', '.join(FORMATS)}")
    session = source if isinstance(source, Session) else Session(source)
    if session.warning:
        raise SessionError(session.warning)
    write: Callable[[Session, Path, Options, Progress], None]
    try:
        write = import_module(f"recorder.convert.{to}_format").write
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("recorder"):
            raise
        raise SessionError(f"{to} needs {error.name}: pip install 'tactile-rig[export]'") from error
    with building(destination) as beside:
        try:
            write(session, beside, options or Options(), progress or ignored)
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            # Libraries say it at length, and of the file beside.
            where = os.fspath(destination)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), where) from error
