"""A lab bench on a terminal: it asks before it moves, and leaves the sensor when the terminal goes.

The emulators run in this process's mock bench, and survive the collection: the arm is seen after
its end.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import pty
import select
import signal
import subprocess
import sys
import termios
from pathlib import Path

import numpy as np
import pytest
import yaml
from support.collecting import ROOT, patient_bench
from support.waiting import until

from recorder import Session
from rig.bench.bench import BenchFile
from rig.core.geometry import invert, transform
from rig.core.mock_names import ARM_FILE
from rig.core.samples import ARM_TRUTH
from rig.core.shared_memory import SharedLatest
from rig.mock.bench import MockBench
from tactile.__main__ import main

# Height above the sensor to which a stopped arm retracts, less the tolerance of the move [mm].
RETRACTED = 15.0


class LabBench:
    """Emulators, and a bench file that knows their addresses only."""

    def __init__(self, folder: Path) -> None:
        file = BenchFile.read(patient_bench(folder, "tacpalm"))
        self.run_folder = folder / "run"
        self.run_folder.mkdir()
        self.mock = MockBench(file, self.run_folder)
        lab = {**self.mock.file.content, "mock": False, "world": None}
        self.file = folder / "lab.yaml"
        self.file.write_text(yaml.safe_dump(lab))
        self._to_contact = invert(file.bench.contact_frame)

    def tip(self) -> float:
        """Return the height of the emulated arm's tip above the sensor [mm]."""
        with contextlib.closing(SharedLatest.attach(self.run_folder / ARM_FILE, ARM_TRUTH)) as arm:
            record = arm.read()
        assert record is not None
        return 1e3 * float(transform(self._to_contact, record["pose"][:3])[2])


class Terminal:
    """A command on a terminal of its own, as its session's leader."""

    def __init__(self, *arguments: str) -> None:
        self.master, slave = pty.openpty()

        def own_terminal() -> None:
            # Undo nohup, under which the tests may run.
            signal.signal(signal.SIGHUP, signal.SIG_DFL)
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            [sys.executable, "-u", "-m", "tactile", *arguments],
            cwd=ROOT,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            start_new_session=True,
            preexec_fn=own_terminal,
        )
        os.close(slave)
        self.text = ""

    def read_until(self, word: str) -> None:
        """Read the output until `word` is in it."""
        until(lambda: word in self.text or not self._read(), 0.0)
        assert word in self.text, self.text

    def wait(self) -> int:
        """Return the exit code, reading the output meanwhile."""
        until(lambda: not self._read(), 0.0)
        return self.process.wait(240)

    def _read(self) -> bool:
        """Read what comes within a tenth of a second; False once the command has ended."""
        if select.select([self.master], [], [], 0.1)[0]:
            try:
                self.text += os.read(self.master, 4096).decode(errors="replace")
            except OSError:
                return False
        return True

    def close(self) -> None:
        """Close the terminal, like its window: the kernel sends SIGHUP to the whole group."""
        if self.master >= 0:
            os.close(self.master)
            self.master = -1

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()


@pytest.mark.slow
def test_a_closed_terminal_retracts_the_arm_and_closes_the_session(tmp_path: Path) -> None:
    session, lab = tmp_path / "s.zarr", LabBench(tmp_path)
    words = ("collect", "--bench", str(lab.file), "--out", str(session), "--targets", "4")
    none = str(tmp_path / "none")
    with lab.mock, Terminal(*words, "--calibrations", none) as terminal:
        terminal.read_until("to start, anything")
        # The first four targets are the shallowest of the plan.
        for word in (
            *("LAB BENCH", "5 mm/s near the sensor", "x -10 to 10 mm", "depth     1.125 mm"),
            "indenter  cylinder",
        ):
            assert word in terminal.text
        assert not session.exists()
        os.write(terminal.master, b"move\n")
        terminal.read_until("target 1/4")
        until(lambda: lab.tip() < -0.2 or terminal.process.poll() is not None)
        terminal.close()
        assert terminal.process.wait(240) == 130
        assert lab.tip() > RETRACTED
    found = Session(session)
    assert found.status == "stopped"
    assert found.attrs["reason"] == "the terminal was closed"
    assert not found.attrs["mock"]
    assert found.attrs["indenter_description"]["source"] == "paper"
    # The session holds the retract, and every stream was closed in order.
    place = np.asarray(found.streams["pose"].array("value"))[-1, :3]
    assert 1e3 * transform(invert(found.attrs["contact_frame"]), place)[2] > RETRACTED


@pytest.mark.slow
@pytest.mark.parametrize(
    ("early", "answer"), [(b"", b"\x03"), (b"\nmove\nmo", b"ve\n")], ids=["ctrl-c", "typed-before"]
)
def test_anything_but_the_word_starts_nothing(
    gripping: Path, tmp_path: Path, early: bytes, answer: bytes
) -> None:
    session = tmp_path / "s.zarr"
    with Terminal(
        *("collect", "--bench", str(gripping), "--out", str(session)),
        *("--calibrations", str(tmp_path / "none")),
    ) as terminal:
        os.write(terminal.master, early)
        terminal.read_until("to start, anything")
        os.write(terminal.master, answer)
        assert terminal.wait() == 130
        assert "nothing was recorded" in terminal.text
    assert not session.exists()


@pytest.fixture(name="gripping")
def bench_with_a_gripper(tmp_path: Path) -> Path:
    content = BenchFile.read(patient_bench(tmp_path, "tacpalm")).content
    gripper = {"kind": "robotiq_2f", "port": str(tmp_path / "no-such-port"), "speed": 40}
    lab = {**content, "mock": False, "world": None, "gripper": gripper}
    (tmp_path / "gripping.yaml").write_text(yaml.safe_dump(lab))
    return tmp_path / "gripping.yaml"


@pytest.mark.parametrize(("answer", "code"), [(b"grip\n", 3), (b"no\n", 130)])
def test_the_gripper_says_how_it_moves_and_waits_for_its_word(
    gripping: Path, answer: bytes, code: int
) -> None:
    with Terminal("grip", "--bench", str(gripping)) as terminal:
        terminal.read_until("to start, anything")
        for word in ("the gripper WILL move", "speed     40 of 255", "force     150 of 255"):
            assert word in terminal.text
        os.write(terminal.master, answer)
        assert terminal.wait() == code
    assert ("no-such-port" in terminal.text) == (code == 3)


def test_the_gripper_moves_only_from_a_terminal(
    gripping: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    assert main(["grip", "--bench", str(gripping)]) == 2
    assert "no terminal to ask on" in capsys.readouterr().err
