"""Folder of a force model: a path, a URL, or the name of an installed one."""

import os
import tempfile
from pathlib import Path, PurePosixPath
from urllib.parse import urlsplit

from learning import published
from learning.errors import LearningError
from learning.plugins import plugin_names
from recorder.errors import SessionError
from recorder.store import is_url, locate

# Folder that models of URLs are copied to, below the working directory.
COPIES = Path("models")
# Files of a model: those that it must have, and those that it may have.
REQUIRED = ("config.yaml", "model.safetensors")
OPTIONAL = ("model.onnx", "intervals.json", "card.md")
_SOURCE = "copied-from"


def model_folder(name: str | os.PathLike[str]) -> Path:
    """Return the folder of a force model: a folder, a URL, a file in either, or the `demo`.

    A model of a URL is copied to `models/NAME` first, unless it is there. Weights are safetensors,
    so no code in them runs.
    """
    text = os.fspath(name).rstrip("/")
    above, _, last = text.rpartition("/")
    if last in (*REQUIRED, *OPTIONAL):
        text = above or os.curdir
    if is_url(text):
        return _copied(text)
    installed = Path(published.__file__).parent / text
    for folder in (Path(text), installed):
        if folder.is_dir():
            return folder
    raise LearningError(
        f"model: found {text!r}; no such folder; allowed: the folder of a trained force model, its "
        "URL, or demo"
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
        files, path = locate(address)
        return files.read(path)
    except (FileNotFoundError, SessionError) as error:
        if optional and isinstance(error, FileNotFoundError):
            return None
        raise LearningError(f"{address}: cannot be read: {type(error).__name__}: {error}") from None
