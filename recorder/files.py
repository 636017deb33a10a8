"""Where the files of a session lie: this machine's disk, or a remote store behind a URL.

Readers ask for files through `Files` and name them by `Path`; below a URL a path is the key of an
object. Writers always write to a disk, and use it directly.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import zarr

from recorder.errors import SessionError

Range = tuple[int, int]
"""Offset and length in a file [bytes]."""


class Files(Protocol):
    """Reading, by name."""

    @property
    def local(self) -> bool:
        """Whether the paths are those of this machine."""
        ...

    def name(self, path: Path) -> str:
        """Return how a person would write the path."""
        ...

    def read(self, path: Path) -> bytes:
        """Return a whole file.

        Raises:
            FileNotFoundError: No such file.
        """
        ...

    def tail(self, path: Path, nbytes: int) -> bytes:
        """Return the last `nbytes` of a file, or all of a shorter one.

        Raises:
            FileNotFoundError: No such file.
        """
        ...

    def ranges(self, path: Path, wanted: Sequence[Range]) -> list[bytes]:
        """Return parts of a file; a part that reaches behind its end is short.

        Raises:
            FileNotFoundError: No such file.
        """
        ...

    def groups(self, path: Path) -> list[Path]:
        """Return the directories right below one that hold a `zarr.json`, sorted."""
        ...

    def listed(self, path: Path) -> list[Path]:
        """Return all files below a directory."""
        ...

    def sizes(self, path: Path) -> dict[Path, int]:
        """Return all files below a directory with their sizes [bytes]."""
        ...

    def array(self, path: Path) -> zarr.Array[Any]:
        """Return a Zarr array, read-only."""
        ...


class LocalFiles:
    """The disk of this machine."""

    local = True

    def name(self, path: Path) -> str:
        """Return the path as it is."""
        return str(path)

    def read(self, path: Path) -> bytes:
        """Return a whole file."""
        return path.read_bytes()

    def tail(self, path: Path, nbytes: int) -> bytes:
        """Return the last bytes of a file."""
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            return os.pread(file.fileno(), nbytes, max(size - nbytes, 0))

    def ranges(self, path: Path, wanted: Sequence[Range]) -> list[bytes]:
        """Return parts of a file."""
        fd = os.open(path, os.O_RDONLY)
        try:
            return [os.pread(fd, nbytes, offset) for offset, nbytes in wanted]
        finally:
            os.close(fd)

    def groups(self, path: Path) -> list[Path]:
        """Return the Zarr nodes right below a directory."""
        return sorted(entry.parent for entry in path.glob("*/zarr.json"))

    def listed(self, path: Path) -> list[Path]:
        """Return all files below a directory."""
        return [entry for entry in path.rglob("*") if entry.is_file()]

    def sizes(self, path: Path) -> dict[Path, int]:
        """Return all files below a directory with their sizes."""
        found = {}
        for entry in self.listed(path):
            try:
                found[entry] = entry.stat().st_size
            except FileNotFoundError:  # sealed or removed meanwhile, by whoever records
                continue
        return found

    def array(self, path: Path) -> zarr.Array[Any]:
        """Return a Zarr array."""
        return zarr.open_array(path, mode="r")


LOCAL = LocalFiles()
"""The only one that writers know."""


def is_url(place: str | os.PathLike[str]) -> bool:
    """Return whether a place is named by a URL, such as `s3://bucket/x.zarr`."""
    return isinstance(place, str) and "://" in place


def locate(
    place: str | os.PathLike[str], storage_options: Mapping[str, Any] | None = None
) -> tuple[Files, Path]:
    """Return the files that a place is in, and its path among them.

    Args:
        place: A path, or a URL that fsspec knows.
        storage_options: What fsspec needs to open the URL, e.g. `{"anon": True}`.

    Raises:
        SessionError: An unknown kind of URL, a missing library, or options for a local path.
    """
    if is_url(place):
        from recorder.remote import open_url

        return open_url(str(place), storage_options or {})
    if storage_options:
        raise SessionError(f"{place}: storage options are for URLs; this is a path")
    return LOCAL, Path(place)


def read_document(files: Files, path: Path) -> dict[str, Any]:
    """Return the JSON object in a file.

    Raises:
        SessionError: The file is missing, or not a JSON object.
    """
    try:
        document = json.loads(files.read(path))
    except FileNotFoundError:
        raise SessionError(f"{files.name(path)}: missing") from None
    except (OSError, ValueError) as error:
        raise SessionError(f"{files.name(path)}: not readable as JSON: {error}") from error
    if not isinstance(document, dict):
        found = type(document).__name__
        raise SessionError(f"{files.name(path)}: found {found}, expected a JSON object")
    return document
