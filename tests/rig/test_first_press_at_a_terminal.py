"""The first press of a lab sensor goes on with Enter, and stops at any other answer."""

from __future__ import annotations

import os
import pty
import select
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
# Steps that a recorder would press; each asks on the terminal before the next.
STEPS = """
from pathlib import Path
from types import SimpleNamespace

from rig.acquire.calibration.calibration import Calibration
from rig.acquire.no_gauge import press_in_steps
from rig.cli.options import confirm
from rig.acquire.control import Interrupted
from rig.bench.bench import bench_from
from rig.core.config import read_yaml
from rig.core.packaged import BENCHES

bench = bench_from(read_yaml(BENCHES / "gelsight.yaml", BENCHES), "gelsight.yaml")
session = SimpleNamespace(signal=None, path=Path("x.zarr"))

def record(name, plan, settings, after_target):
    for index in range(len(plan)):
        print(f"pressed {index}", flush=True)
        after_target(SimpleNamespace(index=index), session)

try:
    press_in_steps(bench, Calibration(), 1e-3, record, confirm)
    print("all pressed")
except Interrupted as error:
    print(f"stopped: {error}")
"""


def at_a_terminal(answers: list[str]) -> str:
    """Answer each question of the first press in turn; return what the terminal showed."""
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(ROOT)
        os.environ["PYTHONPATH"] = str(ROOT)
        os.execv(sys.executable, [sys.executable, "-c", STEPS])
    shown, left, end = "", list(answers), time.monotonic() + 120
    while time.monotonic() < end:
        if not select.select([terminal], [], [], 1.0)[0]:
            continue
        try:
            part = os.read(terminal, 4096)
        except OSError:  # the process has closed its end
            break
        if not part:
            break
        shown += part.decode()
        if shown.count("anything else to stop:") > len(answers) - len(left) and left:
            os.write(terminal, left.pop(0).encode())
    os.close(terminal)
    os.waitpid(process, 0)
    return shown


@pytest.mark.parametrize("answer", ["q\n", " \n", "\x03", "\x04"], ids=["q", "space", "^C", "^D"])
def test_an_answer_other_than_enter_stops_before_the_next_step(answer: str) -> None:
    shown = at_a_terminal(["\n", answer])
    assert "first press, air" in shown
    assert "next: " in shown
    assert "pressed 1" in shown
    assert "pressed 2" not in shown
    assert "stopped: the answer was not Enter" in shown


def test_enter_goes_through_all_steps() -> None:
    shown = at_a_terminal(["\n"] * 12)
    assert "all pressed" in shown
    assert shown.count("next: ") == shown.count("pressed ") - 1
