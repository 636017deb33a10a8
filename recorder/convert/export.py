"""Write a session, or a marker archive, in a format of other programs: a row a format."""

import errno
import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from recorder.archive import MarkerArchive
from recorder.errors import SessionError
from recorder.progress import ReportItems
from recorder.session.reader import Session
from recorder.spec import ARCHIVE_FORMAT
from recorder.store.documents import says_it_is
from recorder.store.files import building, locate


@dataclass(frozen=True, slots=True)
class Options:
    """Options of an export; a format ignores those that do not apply to it."""

    images: Literal["stored", "pixels"] = "stored"
    """zarr, hdf5: images as they are stored, or decoded to lossless pixels."""
    valid_only: bool = False
    """lerobot, genforce: leave out rows that have no sample near enough."""


# Longest name of a file.
_LONGEST = 80


def file_name(text: object) -> str:
    """Return a text as a file name: one component, letters, digits, dot, dash and underscore.

    `../x` becomes `_x`, an empty text `unnamed`: no name leads out of its folder.
    """
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", str(text)).lstrip(".")
    return plain[:_LONGEST] or "unnamed"


@dataclass(frozen=True, slots=True)
class Format:
    """A row of `FORMATS`."""

    content: str
    """Content of the export, and `(a file)` or `(a folder)`."""
    module: str
    """Module whose `write(session, path, options, progress)` writes a session."""
    of_archives: bool = False
    """True if its `write_archive` writes a marker archive."""


# Export formats by name. Other packages may add rows.
FORMATS: dict[str, Format] = {
    "zarr": Format("a copy of the session, verified (a folder)", "recorder.convert.zarr_format"),
    "lerobot": Format(
        "LeRobot dataset v3.0, one episode per target (a folder)", "recorder.convert.lerobot_format"
    ),
    "mcap": Format(
        "MCAP with Foxglove's schemas, every sample at its own time (a file)",
        "recorder.convert.mcap_format",
    ),
    "hdf5": Format(
        "HDF5, the whole session with names, types and attributes (a file)",
        "recorder.convert.hdf5_format",
    ),
    "genforce": Format(
        "the folders of the GenForce recordings, four phases per point (a folder); of a marker "
        "archive, of their training",
        "recorder.convert.genforce_format",
        of_archives=True,
    ),
}


def export(
    source: Session | str | os.PathLike[str],
    destination: str | os.PathLike[str],
    to: str,
    *,
    options: Options | None = None,
    progress: ReportItems | None = None,
) -> tuple[str, ...]:
    """Write a finished session or a marker archive in another format. The source is only read.

    The destination is created atomically. Rows are streamed: memory does not grow with the length
    of the session, except for the frames view (up to 0.6 kB per row) and the times.

    Args:
        source: A session, or the path or URL of a session or of a marker archive.
        destination: File or folder to create; must not exist.
        to: One of `FORMATS`.
        options: Options of the format.
        progress: Called with the number of rows done and the total.

    Returns:
        Notes on what the format cannot hold of a marker archive.

    Raises:
        SessionError: An unknown format, or none for such a source; an unfinished or corrupt
            source, an existing destination, a missing library, or a session that the format cannot
            represent.
        OSError: The disk is full, or not writable.
    """
    if to not in FORMATS:
        raise SessionError(f"found format {to!r}; known: {', '.join(FORMATS)}")
    opened = source if isinstance(source, Session) else _opened(source)
    of_archive = isinstance(opened, MarkerArchive)
    if of_archive and not FORMATS[to].of_archives:
        formats = ", ".join(name for name, row in FORMATS.items() if row.of_archives)
        raise SessionError(f"{source}: {to} is not for a marker archive; allowed: {formats}")
    write: Callable[[Any, Path, Options, ReportItems], Iterable[str] | None]
    module = FORMATS[to].module
    try:
        write = getattr(import_module(module), "write_archive" if of_archive else "write")
    except ModuleNotFoundError as error:
        if error.name is None or error.name.partition(".")[0] == module.partition(".")[0]:
            raise
        raise SessionError(f"{to} needs {error.name}: pip install 'tactile-rig[export]'") from error
    with building(Path(destination)) as beside:
        try:
            tick = progress or (lambda done, total: None)
            return tuple(write(opened, beside, options or Options(), tick) or ())
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            # Libraries report this at length, and for the temporary file.
            path = os.fspath(destination)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path) from error


def _opened(source: str | os.PathLike[str]) -> Session | MarkerArchive:
    files, path = locate(source)
    if says_it_is(path, files, ARCHIVE_FORMAT):
        return MarkerArchive(source)
    session = Session(source)
    if session.warning:
        raise SessionError(session.warning)
    return session
