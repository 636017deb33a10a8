"""The one call behind `python -m recorder export`."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path

from recorder.errors import SessionError
from recorder.export.options import Options, Progress, ignored
from recorder.export.target import building
from recorder.reader import Session

FORMATS: Mapping[str, str] = {
    "lerobot": "LeRobot dataset v3.0, one episode per target (a folder)",
    "mcap": "MCAP with Foxglove's schemas, every sample at its own time (a file)",
    "hdf5": "HDF5, the whole session with names, types and attributes (a file)",
    "genforce": "the folders of the GenForce recordings, four phases per point (a folder)",
}
"""What can be written, and what it is."""


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
        write = import_module(f"recorder.export.{to}_format").write
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
