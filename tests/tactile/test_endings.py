"""The end of a command: exit code and printed line of every kind of error."""

import errno
import subprocess
import sys
from pathlib import Path

import pytest
from support.sessions import make_session

from learning.errors import LearningError
from recorder import SessionError
from recorder.command_line.errors import CommandError
from recorder.processes import WorkerLost
from rig.acquire.control import Interrupted
from rig.core.errors import ConfigError, DeviceLost, SafetyStop
from sim.errors import SceneError, SimulationDiverged
from tactile.run import ended, joined


def raised(error: BaseException) -> int:
    """Return the exit code of a command that raises `error`."""

    def run() -> int:
        raise error

    return ended(run, "repeat it")


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (CommandError("a: 1; allowed: 2"), 2, "wrong input: a: 1; allowed: 2"),
        (ConfigError("b"), 2, "wrong input: b"),
        (SessionError("s"), 2, "wrong input: s"),
        (SceneError("c"), 2, "wrong input: c"),
        (LearningError("l"), 2, "wrong input: l"),
        (WorkerLost("w"), 2, "cannot continue: w"),
        (DeviceLost("force"), 3, "device lost: force; nothing was recorded"),
        (SafetyStop("5 N"), 4, "safety stop: 5 N; nothing was recorded"),
        (Interrupted(), 130, "interrupted; nothing was recorded"),
        (KeyboardInterrupt(), 130, "interrupted; repeat it"),
        (
            SimulationDiverged("at 1 mm", tuple("abcdefg")),
            1,
            "no solution: at 1 mm\n" + "\n".join(f"  tried: {each}" for each in "cdefg"),
        ),
        (
            FileNotFoundError(errno.ENOENT, "No such file or directory", "x.npy"),
            2,
            "cannot read or write: x.npy: No such file or directory",
        ),
        (
            OSError(errno.EROFS, "Read-only file system", "s.log"),
            2,
            "cannot read or write: s.log: Read-only file system; mounted read-only: name a folder "
            "on another disk",
        ),
        (PermissionError("out: not writable"), 2, "cannot read or write: out: not writable"),
        (
            BrokenPipeError(errno.EPIPE, "Broken pipe"),
            2,
            "cannot read or write: [Errno 32] Broken pipe",
        ),
    ],
    ids=lambda each: type(each).__name__,
)
def test_every_known_error_has_its_code_and_line(
    error: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert raised(error) == code
    assert capsys.readouterr().err == f"{line}\n"


@pytest.mark.parametrize("error", [ValueError("x"), RuntimeError("y"), ZeroDivisionError()])
def test_other_errors_are_faults_and_keep_their_traceback(error: Exception) -> None:
    with pytest.raises(type(error)):
        raised(error)


@pytest.mark.parametrize("words", ["session info s.zarr", "--help", "sim --help"])
def test_a_reader_that_leaves_ends_the_command_quietly(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_session(tmp_path / "s.zarr", seconds=0.5, names=("force",))
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    monkeypatch.chdir(tmp_path)
    program = [sys.executable, "-m", "tactile", *words.split()]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        erred = process.stderr.read()
    assert (process.returncode, erred) == (141, b"")


def test_lists_of_negative_numbers_are_joined_to_their_option() -> None:
    given = ["--at", "-4,0", "--depth", "-1", "--out", "-", "--at=-1,2", "-1,2"]
    assert joined(given) == ["--at=-4,0", "--depth", "-1", "--out", "-", "--at=-1,2", "-1,2"]
