"""Trained models that people can take: a folder or web address with an index and its models.

    index.json        name, licence, text and files of each model, with sizes and SHA-256
    NAME/             card.md, config.yaml, model.safetensors, model.onnx, ...

`get` copies a model into `models/NAME` of the user, once every file has its size and hash.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import re
import shutil
import tempfile
import urllib.error
import urllib.request
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from recorder.errors import SessionError
from recorder.store import replace_file

INDEX = "index.json"
# Folder of the user's models, below the working directory, and the file that names the one in use.
OWN, IN_USE = Path("models"), "in-use"
# Largest index, and largest file [B]: more is refused, whoever publishes it.
INDEX_BYTES, FILE_BYTES = 1 << 20, 1 << 33
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_TIMEOUT_S = 30.0


@dataclass(frozen=True, slots=True)
class PublishedFile:
    """A file of a model."""

    path: str
    """Path in the model's folder, with slashes."""
    bytes: int
    """Its size."""
    sha256: str
    """Its SHA-256, as hexadecimal digits."""


@dataclass(frozen=True, slots=True)
class PublishedModel:
    """One entry of an index."""

    name: str
    licence: str
    text: str
    """Its output, its input and its error, in a line."""
    files: tuple[PublishedFile, ...]


def packaged() -> Path:
    """Return the folder of the models that are installed with the package."""
    found = importlib.util.find_spec("learning")
    if found is None or found.origin is None:
        raise SessionError("learning: is not installed; allowed: an installed package")
    return Path(found.origin).parent / "published"


def listed(place: str | Path) -> tuple[PublishedModel, ...]:
    """Return the models of a folder or web address.

    Raises:
        SessionError: There is no index, or it is corrupt.
    """
    where = f"{place}/{INDEX}"
    try:
        content = json.loads(_read(place, INDEX, INDEX_BYTES))
        models = tuple(
            PublishedModel(
                _plain(row["name"]),
                str(row["licence"]),
                str(row["text"]),
                tuple(_file(each) for each in row["files"]),
            )
            for row in content["models"]
        )
    except (ValueError, TypeError, KeyError) as error:
        raise SessionError(f"{where}: not an index of models: {error!r}") from None
    if len({model.name for model in models}) < len(models):
        raise SessionError(f"{where}: found a name twice; allowed: once")
    return models


def get(name: str, place: str | Path, out: Path) -> Path:
    """Copy a model to `out/NAME` and return that folder; one that is there is checked.

    Raises:
        SessionError: There is no such model, or a file differs from the index.
    """
    known = {model.name: model for model in listed(place)}
    if name not in known:
        raise SessionError(f"{place}: no model {name!r}; known: {', '.join(known) or 'none'}")
    model, folder = known[name], out / name
    if folder.exists():
        require_same(model, folder)
        return folder
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out, prefix=".getting-") as temporary:
        part = Path(temporary) / name
        for file in model.files:
            path = part / file.path
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(_read(place, f"{name}/{file.path}", file.bytes))
        require_same(model, part)
        part.rename(folder)
    return folder


def require_same(model: PublishedModel, folder: Path) -> None:
    """Reject a folder whose files differ from those of a model.

    Raises:
        SessionError: Names the file.
    """
    for file in model.files:
        path = folder / file.path
        if not path.is_file():
            raise SessionError(f"{path}: missing; allowed: all files of {model.name}")
        found = _sha256(path.read_bytes())
        if found != file.sha256:
            raise SessionError(f"{path}: found SHA-256 {found[:12]}; allowed: {file.sha256[:12]}")


def use(name: str, out: Path = OWN) -> Path:
    """Make a model that was taken the default of `tactile live`; return its folder.

    Raises:
        SessionError: There is no such model.
    """
    folder = find(name, out)
    if folder is None:
        raise SessionError(f"{name}: no model of that name in {out}/; `tactile models get {name}`")
    out.mkdir(parents=True, exist_ok=True)
    replace_file(out / IN_USE, f"{name}\n".encode())
    return folder


def find(name: str | None, out: Path = OWN) -> Path | None:
    """Return the folder of a model by path or name; None if there is none.

    Args:
        name: A folder; or the name of a model in `out`, or of an installed one. None: the model in
            use.
        out: Folder of the user's models.
    """
    if name is None:
        stored = out / IN_USE
        if not stored.is_file():
            return None
        name = stored.read_text(encoding="utf-8").strip()
    if Path(name).is_dir():
        return Path(name)
    if not _NAME.fullmatch(name):
        return None
    return next((place / name for place in (out, packaged()) if (place / name).is_dir()), None)


def add(folder: Path, place: Path, name: str, *, licence: str, text: str) -> PublishedModel:
    """Copy a model's folder to a place that others can take it from, and list it there.

    Raises:
        SessionError: The name is not plain, or there is such a model.
    """
    models = listed(place) if (place / INDEX).exists() else ()
    if _plain(name) in {model.name for model in models} or (place / name).exists():
        raise SessionError(f"{place / name}: exists; allowed: a new name")
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    kept = [path.relative_to(folder) for path in files]
    found = tuple(
        PublishedFile(path.as_posix(), len(data), _sha256(data))
        for path in kept
        for data in [(folder / path).read_bytes()]
    )
    for path in kept:
        copied = place / name / path
        copied.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(folder / path, copied)
    model = PublishedModel(name, licence, text, found)
    content = {"models": [asdict(each) for each in (*models, model)]}
    replace_file(place / INDEX, json.dumps(content, indent=1).encode() + b"\n")
    return model


def _read(place: str | Path, path: str, most: int) -> bytes:
    """Return a file of a folder or web address, of at most some bytes."""
    where = f"{place}/{path}"
    try:
        if str(place).startswith(("http://", "https://")):
            with urllib.request.urlopen(where, timeout=_TIMEOUT_S) as reply:
                data: bytes = reply.read(most + 1)
        else:
            with (Path(place) / path).open("rb") as file:
                data = file.read(most + 1)
    except (OSError, urllib.error.URLError, ValueError) as error:
        raise SessionError(f"{where}: cannot be read: {error}") from None
    if len(data) > most:
        raise SessionError(f"{where}: found more than {most:,} bytes; allowed: that many")
    return data


def _file(row: dict[str, Any]) -> PublishedFile:
    path, size, digest = str(row["path"]), int(row["bytes"]), str(row["sha256"])
    parts = PurePosixPath(path).parts
    if not parts or PurePosixPath(path).is_absolute() or ".." in parts or "\\" in path:
        raise ValueError(f"path {path!r} leaves the model's folder")
    if not 0 <= size <= FILE_BYTES or not re.fullmatch("[0-9a-f]{64}", digest):
        raise ValueError(f"{path}: size {size}, SHA-256 {digest!r}")
    return PublishedFile(path, size, digest)


def _plain(name: str) -> str:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise SessionError(f"name: found {name!r}; allowed: letters, digits and . _ -")
    return name


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
