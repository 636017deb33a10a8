"""Machines without a passwd entry, locks, a home, a writable folder, UTF-8 or shared memory."""

import errno
import fcntl
import getpass
import os
import stat
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.sessions import make_session

from learning.data.dataset import _require_room
from learning.errors import LearningError
from recorder import Session, SessionError
from recorder.catalogue import FILE, Catalogue
from recorder.session import StreamWriter
from recorder.store import replace_file
from rig.core.names import operator_name
from tactile.run import main

Patch = pytest.MonkeyPatch


def refusing(number: int):
    """Return a function that fails as the file system does with this error."""

    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    return refuse


def test_a_user_without_a_name_is_an_operator(monkeypatch: Patch) -> None:
    def nobody() -> str:
        raise KeyError("getpwuid(): uid not found: 12345")

    monkeypatch.setattr(getpass, "getuser", nobody)
    assert operator_name("") == f"uid {os.getuid()}"
    assert operator_name("Ada") == "Ada"


@pytest.mark.parametrize("number", [errno.EROFS, errno.ENOSPC])
def test_a_folder_that_cannot_be_written_is_listed(
    number: int, tmp_path: Path, monkeypatch: Patch
) -> None:
    make_session(tmp_path / "s.zarr", seconds=0.5, names=("force",))
    monkeypatch.setattr(Path, "write_text", refusing(number))
    monkeypatch.setattr(Path, "unlink", refusing(number))
    catalogue = Catalogue(tmp_path)
    catalogue.refresh()
    assert [row.path for row in catalogue] == ["s.zarr"]
    assert not (tmp_path / FILE).exists()


def test_a_folder_that_cannot_be_synced_keeps_its_files(tmp_path: Path, monkeypatch: Patch) -> None:
    def only_files(fd: int) -> None:
        if stat.S_ISDIR(os.fstat(fd).st_mode):
            refusing(errno.EINVAL)()

    monkeypatch.setattr(os, "fsync", only_files)
    replace_file(tmp_path / "a", b"kept")
    assert (tmp_path / "a").read_bytes() == b"kept"
    monkeypatch.setattr(os, "fsync", refusing(errno.EINVAL))
    with pytest.raises(OSError, match="Invalid argument"):
        replace_file(tmp_path / "b", b"lost")


def test_a_disk_without_locks_is_named_with_its_cure(tmp_path: Path, monkeypatch: Patch) -> None:
    path = make_session(tmp_path / "s.zarr", seconds=0.5, names=("force",))
    monkeypatch.setattr(fcntl, "flock", refusing(errno.ENOLCK))
    with pytest.raises(SessionError, match=r"streams/force: its file .* locks .*; record on a loc"):
        StreamWriter.open(path / "streams/force")
    monkeypatch.undo()
    assert len(Session(path).streams["force"])


def test_an_ascii_terminal_shows_a_name_by_its_codes(tmp_path: Path) -> None:
    make_session(tmp_path / "s\u00e9ance.zarr", seconds=0.5, names=("force",))
    program = [sys.executable, "-m", "tactile", "session", "list", str(tmp_path)]
    path = str(Path(__file__).parents[1])
    env = {**os.environ, "PYTHONIOENCODING": "ascii", "PYTHONPATH": path}
    ended = subprocess.run(program, env=env, capture_output=True, check=True)
    assert b"s\\xe9ance.zarr" in ended.stdout


def test_without_a_home_caches_are_kept_in_a_folder_of_our_own(
    tmp_path: Path, monkeypatch: Patch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path / "nowhere"))
    for name in ("XDG_CACHE_HOME", "XDG_CONFIG_HOME"):
        monkeypatch.setenv(name, "x")
        monkeypatch.delenv(name)
    assert main(["--version"]) == 0
    folder = Path(os.environ["XDG_CACHE_HOME"])
    assert folder.parent == tmp_path
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_a_batch_that_shared_memory_cannot_hold_is_refused(monkeypatch: Patch) -> None:
    docker = SimpleNamespace(f_blocks=1 << 14, f_frsize=1 << 12)
    monkeypatch.setattr(os, "statvfs", lambda _: docker)
    sample = {"image": torch.from_numpy(np.zeros((10, 1_000_000), np.uint8))}
    _require_room([sample], workers=2)
    with pytest.raises(LearningError, match=r"/dev/shm: has 67 MB; 2 workers .* need 160 MB"):
        _require_room([sample] * 4, workers=2)
