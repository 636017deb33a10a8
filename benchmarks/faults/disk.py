"""Small disks that fill up: a tmpfs, which only root can mount."""

from __future__ import annotations

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path


class CannotMount(Exception):
    """Raised if no tmpfs can be mounted, with the reason."""


@contextlib.contextmanager
def tmpfs(folder: Path, megabytes: int) -> Iterator[None]:
    """Mount a disk of a few megabytes in a new folder, for the time of the context."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder)]
    try:
        done = subprocess.run(mount, capture_output=True, text=True, check=False)
    except OSError as error:
        raise CannotMount(str(error)) from error
    if done.returncode != 0:
        raise CannotMount(done.stderr.strip() or f"mount ended with {done.returncode}")
    try:
        yield
    finally:
        # Lazily: files may still be open for a moment.
        subprocess.run(["umount", "--lazy", str(folder)], check=False)
