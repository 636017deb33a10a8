"""File changes that are either whole or not there at all, also after a power cut."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from recorder.errors import SessionError
from recorder.store.files import LOCAL, read_document

TEMPORARY = ".tmp"
"""Suffix of a file that is still being written and means nothing yet."""


def sync_directory(path: Path) -> None:
    """Make the names in a directory as durable as the files they point to."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def replace_file(path: Path, data: bytes, *, temporary: Path | None = None) -> None:
    """Write `data` to `path`, so that a reader sees the old content or all of the new one.

    Args:
        path: The file.
        data: Its content.
        temporary: Name beside it while it is written, where several may write the same file at
            the same time; `path` with the suffix `TEMPORARY` when None.
    """
    temporary = temporary or path.with_name(path.name + TEMPORARY)
    fd = os.open(temporary, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o644)
    try:
        rest = memoryview(data)
        while rest:
            rest = rest[os.write(fd, rest) :]
        os.fsync(fd)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    finally:
        os.close(fd)
    temporary.replace(path)
    sync_directory(path.parent)


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Replace a JSON file atomically.

    Numpy scalars and arrays become numbers and lists.

    Raises:
        SessionError: The document holds something JSON cannot, NaN included.
    """
    try:
        text = json.dumps(document, indent=2, allow_nan=False, default=_plain)
    except (TypeError, ValueError) as error:
        raise SessionError(f"{path}: not storable as JSON: {error}") from error
    replace_file(path, text.encode())


def read_json(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file.

    Raises:
        SessionError: The file is missing, or not a JSON object.
    """
    return read_document(LOCAL, path)


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"{type(value).__name__} is not JSON")
