"""Reads what a session says of itself."""

from pathlib import Path
from typing import Any

from recorder.durable import read_json
from recorder.errors import SessionError
from recorder.spec import FORMAT, FORMAT_VERSION


def read_session_attrs(path: Path) -> dict[str, Any]:
    """Return the attributes of a session.

    Raises:
        SessionError: Not a session, or of a newer format.
    """
    if not path.is_dir():
        raise SessionError(f"{path}: no such session")
    attrs: dict[str, Any] = read_json(path / "zarr.json").get("attributes", {})
    if attrs.get("format") != FORMAT:
        raise SessionError(f"{path}: found format {attrs.get('format')!r}, expected {FORMAT!r}")
    version = attrs.get("format_version")
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise SessionError(
            f"{path}: found format_version {version}, this program reads up to {FORMAT_VERSION}"
        )
    return attrs
