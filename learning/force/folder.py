"""Folder of a force model: a path, a web address, or the name of an installed one."""

import os
import tempfile
import urllib.error
import urllib.request
from pathlib import Path, PurePosixPath
from urllib.parse import urlsplit

from learning import published
from learning.errors import LearningError
from learning.plugins import plugin_names

# Folder that models of web addresses are copied to, below the working directory.
COPIES = Path("models")
# Files of a model: those that it must have, and those that it may have.
REQUIRED = ("config.yaml", "model.safetensors")
OPTIONAL = ("model.onnx", "intervals.json", "card.md")
# Largest file of a web address [B].
FILE_BYTES = 1 << 33
_SOURCE = "copied-from"
_TIMEOUT_S = 30.0


def model_folder(name: str | os.PathLike[str]) -> Path:
    """Return the folder of a force model: a folder, the web address of one, or the `demo`.

    A model of a web address is copied to `models/NAME` first, unless it is there. Weights are
    safetensors, so no code in them runs.
    """
    text = os.fspath(name)
    if text.startswith(("http://", "https://")):
        return _copied(text.rstrip("/"))
    installed = Path(published.__file__).parent / text
    for folder in (Path(text), installed):
        if folder.is_dir():
            return folder
    raise LearningError(
        f"model: found {text!r}; no such folder; allowed: the folder of a trained force model, its "
        "web address, or demo"
    )


def model_name(name: str) -> str:
    """Return a name of another package's model as it is, and the folder of another model."""
    return name if name in plugin_names() else str(model_folder(name))


def _copied(address: str) -> Path:
    name = PurePosixPath(urlsplit(address).path).name
    if not name:
        raise LearningError(f"model: found {address}; allowed: the address of a model's folder")
    folder = COPIES / name
    if folder.exists():
        source = folder / _SOURCE
        if not source.is_file() or source.read_text(encoding="utf-8") != address:
            raise LearningError(
                f"{folder}: found another model than {address}; allowed: no such folder"
            )
        return folder
    COPIES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=COPIES, prefix=".copying-") as temporary:
        part = Path(temporary) / name
        part.mkdir()
        for file in (*REQUIRED, *OPTIONAL):
            data = _read(f"{address}/{file}", optional=file in OPTIONAL)
            if data is not None:
                (part / file).write_bytes(data)
        (part / _SOURCE).write_text(address, encoding="utf-8")
        part.rename(folder)
    return folder


def _read(address: str, *, optional: bool) -> bytes | None:
    """Return the file at an address; None if there is none and it is optional."""
    try:
        with urllib.request.urlopen(address, timeout=_TIMEOUT_S) as reply:
            data: bytes = reply.read(FILE_BYTES + 1)
    except (OSError, urllib.error.URLError, ValueError) as error:
        if optional and isinstance(error, urllib.error.HTTPError) and error.code == 404:
            return None
        raise LearningError(f"{address}: cannot be read: {error}") from None
    if len(data) > FILE_BYTES:
        raise LearningError(f"{address}: found more than {FILE_BYTES:,} bytes; allowed: that many")
    return data
