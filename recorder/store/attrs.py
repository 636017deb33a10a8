"""Reads what a session, or an archive, says of itself."""

from pathlib import Path
from typing import Any

from recorder.errors import SessionError
from recorder.spec import FORMAT, FORMAT_VERSION
from recorder.store.files import LOCAL, Files, read_document


def read_session_attrs(path: Path, files: Files = LOCAL) -> dict[str, Any]:
    """Return the attributes of a session.

    Raises:
        SessionError: Not a session, or of a newer format.
    """
    return read_attrs(path, files, what="session", format_=FORMAT, version=FORMAT_VERSION)


def read_attrs(
    path: Path, files: Files, *, what: str, format_: str, version: int
) -> dict[str, Any]:
    """Return the attributes of what lies at a place.

    Args:
        path: Its directory.
        files: What the directory is in.
        what: How a person calls such a thing.
        format_: What it must say it is.
        version: The newest `format_version` that can be read.

    Raises:
        SessionError: Nothing there, of another format, or of a newer one.
    """
    name = files.name(path)
    if files.local and not path.is_dir():
        raise SessionError(f"{name}: no such {what}")
    try:
        files.read(path / "zarr.json")
    except FileNotFoundError as error:
        if not files.local:  # the store says whether it is the bucket that is missing
            raise SessionError(f"{name}: no such {what} ({error})") from None
    except OSError as error:
        raise SessionError(f"{name}: {error}") from error
    attrs: dict[str, Any] = read_document(files, path / "zarr.json").get("attributes", {})
    if attrs.get("format") != format_:
        raise SessionError(f"{name}: found format {attrs.get('format')!r}, expected {format_!r}")
    found = attrs.get("format_version")
    if not isinstance(found, int) or found > version:
        raise SessionError(
            f"{name}: found format_version {found}, this program reads up to {version}"
        )
    return attrs


def says_it_is(path: Path, files: Files, format_: str) -> bool:
    """Whether what lies at a place is there, readable, and says that it is of a format."""
    try:
        attrs = read_document(files, path / "zarr.json").get("attributes", {})
    except SessionError:
        return False
    return isinstance(attrs, dict) and attrs.get("format") == format_
