"""A process that dies before any chosen call that changes files."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


class Killed(BaseException):
    """Replaces SIGKILL: nothing that the program does afterwards reaches the disk."""


class FailingCalls:
    """Count the calls that change files and die before a chosen one.

    A kill before `fsync` leaves the same files as one before the next change, so it is not counted.
    """

    NAMES = ("pwrite", "pwritev", "posix_fallocate", "write", "truncate", "ftruncate", "unlink")
    PATH_NAMES = ("replace", "unlink", "mkdir", "write_bytes")

    def __init__(self, patch: pytest.MonkeyPatch, fatal: int | None) -> None:
        self.calls = 0
        self._fatal = fatal
        for owner, names in ((os, self.NAMES), (Path, self.PATH_NAMES)):
            for name in names:
                patch.setattr(owner, name, self._counted(getattr(owner, name)))
        patch.setattr(shutil, "rmtree", self._counted(shutil.rmtree))

    def _counted(self, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            self.calls += 1
            if self._fatal is not None and self.calls >= self._fatal:
                raise Killed
            return real(*args, **options)

        return call
