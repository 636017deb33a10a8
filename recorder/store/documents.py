"""Metadata of a session or an archive: a JSON object per group and array."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from recorder.errors import SessionError
from recorder.store.files import Files

# Largest file of metadata that is read [bytes]; the manifest of a day has a tenth of it.
DOCUMENT_MAX = 1 << 28


def read_document(files: Files, path: Path) -> dict[str, Any]:
    """Return the JSON object in a file, whose attributes, if any, are an object as well."""
    try:
        check_document_size(files, path)
        document = json.loads(files.read(path))
    except FileNotFoundError:
        raise SessionError(f"{files.name(path)}: missing") from None
    except (OSError, ValueError, RecursionError) as error:
        raise SessionError(f"{files.name(path)}: not readable as JSON: {error}") from error
    if not isinstance(document, dict):
        found = type(document).__name__
        raise SessionError(f"{files.name(path)}: found {found}, expected a JSON object")
    if not isinstance(document.get("attributes", {}), dict):
        attributes = document["attributes"]
        raise SessionError(
            f"{files.name(path)}: found attributes {attributes!r:.80}, expected a JSON object"
        )
    return document


def check_document_size(files: Files, path: Path) -> None:
    """Reject a local file that is too large for metadata, before it is read."""
    if files.local and (size := path.stat().st_size) > DOCUMENT_MAX:
        raise SessionError(f"{path}: found {size} bytes; allowed for metadata: {DOCUMENT_MAX}")
