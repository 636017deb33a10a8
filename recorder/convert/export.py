"""Implementation of `tactile session export`."""

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

from recorder.archive import MarkerArchive
from recorder.archive.plan import FORMAT as ARCHIVE
from recorder.errors import SessionError
from recorder.session.reader import Session
from recorder.store.durable import sync_directory
from recorder.store.files import locate
from recorder.store.layout import says_it_is

# Options of an export, and its progress callback.

# Called with the number of rows done and the total.
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Options:
    """Options of an export; a format ignores those that do not apply to it."""

    decode: bool = False
    """hdf5: store images as pixels instead of the camera's JPEG bytes."""
    valid_only: bool = False
    """lerobot, genforce: leave out rows that have no sample near enough."""


def ignored(done: int, total: int) -> None:
    """Ignore progress."""


# Output of an export: built under a temporary name, renamed when complete; safe file names.

# Suffix of an export that is being built and not yet valid.
CREATING = ".creating"
_LONGEST = 80


@contextmanager
def building(destination: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield the path to build at; on exit, rename it to its destination, or remove it on error.

    An interruption counts as an error, so the export is either complete or absent.

    Raises:
        SessionError: The destination exists, or its folder does not.
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

    `../x` becomes `_x`, an empty text `unnamed`: no name leads out of its folder.
    """
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", str(text)).lstrip(".")
    return plain[:_LONGEST] or "unnamed"


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


# Export formats with their descriptions.
FORMATS: Mapping[str, str] = {
    "lerobot": "LeRobot dataset v3.0, one episode per target (a folder)",
    "mcap": "MCAP with Foxglove's schemas, every sample at its own time (a file)",
    "hdf5": "HDF5, the whole session with names, types and attributes (a file)",
    "genforce": "the folders of the GenForce recordings, four phases per point (a folder); of a "
    "marker archive, of their training",
}


def export(
    source: Session | str | os.PathLike[str],
    destination: str | os.PathLike[str],
    to: str,
    *,
    options: Options | None = None,
    progress: Progress | None = None,
) -> tuple[str, ...]:
    """Write a finished session in another format. The source is only read.

    A marker archive becomes GenForce's training folders; what they cannot hold is returned.

    The destination is created atomically. Rows are streamed: memory does not grow with the length
    of the session, except for the frames view (up to 0.6 kB per row) and the times.

    Args:
        source: A session, or path or URL of a session or a marker archive.
        destination: File or folder to create; must not exist.
        to: One of `FORMATS`.
        options: Options of the format.
        progress: Called with the number of rows done and the total.

    Raises:
        SessionError: An unknown format, an unfinished or corrupt source, an existing destination,
            a missing library, or a session that the format cannot represent.
        OSError: The disk is full, or not writable.
    """
    if to not in FORMATS:
        raise SessionError(f"found format {to!r}; known: {', '.join(FORMATS)}")
    told = progress or ignored
    if not isinstance(source, Session) and _is_archive(source):
        if to != "genforce":
            raise SessionError(f"found format {to!r}; allowed for a marker archive: genforce")
        write_archive: Callable[[MarkerArchive, Path, Progress], tuple[str, ...]]
        write_archive = import_module("recorder.convert.genforce_archive").write
        with building(destination) as beside:
            return write_archive(MarkerArchive(source), beside, told)
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
            write(session, beside, options or Options(), told)
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            # Libraries report this at length, and for the temporary file.
            where = os.fspath(destination)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), where) from error
    return ()


def _is_archive(source: str | os.PathLike[str]) -> bool:
    files, place = locate(source)
    return says_it_is(place, files, ARCHIVE)
