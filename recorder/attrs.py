"""Reads what a session says of itself."""

from pathlib import Path
from typing import Any

from recorder.errors import SessionError
from recorder.files import LOCAL, Files, read_document
from recorder.spec import FORMAT, FORMAT_VERSION


def read_session_attrs(path: Path, files: Files = LOCAL) -> dict[str, Any]:
    """Return the attributes of a session.

    Raises:
        SessionError: Not a session, or of a newer format.
    """
    name = files.name(path)
    if files.local and not path.is_dir():
        raise SessionError(f"{name}: no such session")
    try:
        files.read(path / "zarr.json")
    except FileNotFoundError as error:
        if not files.local:  # the store says whether it is the bucket that is missing
            raise SessionError(f"{name}: no such session ({error})") from None
    except OSError as error:
        raise SessionError(f"{name}: {error}") from error
    attrs: dict[str, Any] = read_document(files, path / "zarr.json").get("attributes", {})
    if attrs.get("format") != FORMAT:
        raise SessionError(f"{name}: found format {attrs.get('format')!r}, expected {FORMAT!r}")
    version = attrs.get("format_version")
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise SessionError(
            f"{name}: found format_version {version}, this program reads up to {FORMAT_VERSION}"
        )
    return attrs
