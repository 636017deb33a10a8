"""Folders that many tests need alike: made once by a process, copied for each test."""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import tempfile
from collections.abc import Callable, Hashable
from pathlib import Path

_MADE: dict[Hashable, Path] = {}


def copied(path: Path, key: Hashable, make: Callable[[Path], object]) -> None:
    """Copy what `make` writes at the path that it is given to `path`; `key` stands for `make`."""
    if key not in _MADE:
        made = _folder() / str(len(_MADE)) / path.name
        make(made)
        _MADE[key] = made
    shutil.copytree(_MADE[key], path)


@functools.cache
def _folder() -> Path:
    folder = tempfile.mkdtemp(prefix="copied-", dir=os.environ.get("PYTEST_DEBUG_TEMPROOT"))
    owner = os.getpid()

    def remove() -> None:
        if os.getpid() == owner:  # not a fork
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return Path(folder)
