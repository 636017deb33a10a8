"""A session is recorded in a process of its own, at the same terminal."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rig.acquire.control import Interrupted, apart
from rig.core.errors import DeviceLost

SCRIPT = """
import sys
from rig.acquire.control import apart
from tests.rig import test_own_process as functions

if __name__ == "__main__":
    name, *numbers = sys.argv[1:]
    raise SystemExit(apart(getattr(functions, name), *map(int, numbers)))
"""


def reads(code: int) -> int:
    print("read", repr(sys.stdin.readline()), flush=True)
    return code


def waits() -> int:
    print("waiting", flush=True)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    time.sleep(50.0)
    return 1


def dies() -> int:
    os.kill(os.getpid(), signal.SIGSEGV)
    return 0


def loses() -> int:
    raise DeviceLost("the arm is gone")


def stops() -> int:
    raise Interrupted("the answer was another")


def started(tmp_path: Path, *function: str) -> subprocess.Popen[str]:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    return subprocess.Popen(
        [sys.executable, str(script), *function],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )


@pytest.mark.slow
def test_the_function_reads_what_is_typed_and_its_code_comes_back(tmp_path: Path) -> None:
    process = started(tmp_path, "reads", "7")
    assert process.communicate("move\n", timeout=240)[0] == "read 'move\\n'\n"
    assert process.returncode == 7


@pytest.mark.slow
def test_sigterm_is_passed_on_and_waited_for(tmp_path: Path) -> None:
    process = started(tmp_path, "waits")
    assert process.stdout is not None
    assert process.stdout.readline() == "waiting\n"
    process.terminate()
    assert process.wait(240) == 130
    process.communicate()


@pytest.mark.parametrize(
    ("function", "code", "line"),
    [
        (dies, 130, ""),
        (loses, 3, "device lost: the arm is gone; nothing was recorded"),
        (stops, 130, "interrupted; nothing was recorded"),
    ],
)
def test_a_process_that_fails_leaves_this_one_and_ends_with_the_line_of_its_error(
    function: object, code: int, line: str, capfd: pytest.CaptureFixture[str]
) -> None:
    assert apart(function) == code  # type: ignore[arg-type]
    assert capfd.readouterr().err.strip() == line
