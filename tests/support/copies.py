"""Folders that many tests need alike: made once by a process, copied for each test."""

import hashlib
import shutil
from collections.abc import Callable, Hashable
from pathlib import Path

_MADE: dict[Hashable, Path] = {}
folders: list[Path] = []
"""Where these are made: one folder of pytest's, set by conftest."""


def copied(path: Path, key: Hashable, make: Callable[[Path], object]) -> None:
    """Copy what `make` writes at the path that it is given to `path`; `key` stands for `make`."""
    if key not in _MADE:
        made = folders[0] / str(len(_MADE)) / path.name
        make(made)
        _MADE[key] = made
    shutil.copytree(_MADE[key], path)


def digests(path: Path) -> dict[str, str]:
    """Return the SHA-256 of every file in a folder, to compare it with its copies."""
    files = (entry for entry in path.rglob("*") if entry.is_file())
    return {str(f.relative_to(path)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}
