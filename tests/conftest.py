"""Fixtures, and a check that no test leaves a thread or process behind."""

import gc
import os
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from support import copies

from recorder.store import files

# Two workers run the tests; libraries that each use both cores slow them down ten times. Must be
# set before any of them is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# The tests start hundreds of processes: if the environment disables bytecode files, each would
# recompile our modules, and pytest would rewrite the asserts of every file.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False


# The tests write and remove some 100,000 files, which takes a disk as long as all computing.
_RAM = Path("/dev/shm")
if os.access(_RAM, os.W_OK) and shutil.disk_usage(_RAM).free > 4e9:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(_RAM))

# A shell starts background jobs with SIGINT ignored, and Python keeps it so; the tests of Ctrl-C
# must not depend on how they were started.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Flushing guards against power failures, which these tests do not have, and takes a twentieth of
# the time of small sessions.
os.fsync = os.fdatasync = lambda fd: None
files.SYNCFS = None

# Deadlines would measure the machine, not the code.
settings.register_profile("house", deadline=None, max_examples=40)
settings.load_profile("house")


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Search for garbage seldom, and never in the modules that all test files import."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.set_threshold(20_000, 20, 20)
        gc.enable()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m serial`, skip files without such tests, since importing them is slow."""
    if (
        config.option.markexpr not in ("serial", "slow and serial")
        or collection_path.suffix != ".py"
    ):
        return None
    return True if b"mark.serial" not in collection_path.read_bytes() else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    if os.environ.get("RUN_SLOW"):
        return
    skip = pytest.mark.skip(reason="slow: takes minutes; run with RUN_SLOW=1 (make test-slow-sim)")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)


def _children() -> set[int]:
    listed = Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split()
    return {int(pid) for pid in listed}


def _command(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""


@pytest.fixture(autouse=True, scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Give `support.copies` and `tempfile` folders that are removed with all others of the run."""
    copies.folders.append(tmp_path_factory.mktemp("copied"))
    # A solver that diverges leaves its state in the folder of temporary files.
    tempfile.tempdir = os.environ["TMPDIR"] = str(tmp_path_factory.mktemp("temporary"))


@pytest.fixture(autouse=True)
def nothing_left_behind() -> Iterator[None]:
    """Fail a test that leaks a thread or a child process."""
    threads, children = set(threading.enumerate()), _children()
    yield
    # zarr keeps one event loop thread and its pool for the life of the process, tqdm the monitor of
    # its bars, sim the compilers of its kernels, multiprocessing one resource tracker; they are
    # exempt.
    ours = [
        thread
        for thread in set(threading.enumerate()) - threads
        if not thread.name.startswith(("zarr", "asyncio", "kernels"))
        and type(thread).__name__ != "TMonitor"
    ]
    for thread in ours:
        thread.join(2.0)
    left = [thread.name for thread in ours if thread.is_alive()]
    assert not left, f"threads left behind: {left}"
    commands = [_command(pid) for pid in _children() - children]
    kept = [command for command in commands if command and "resource_tracker" not in command]
    assert not kept, f"processes left behind: {kept}"
