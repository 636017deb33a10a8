"""The first press of a lab sensor goes on with the word `move`, and stops at any other answer."""

import os
import pty
import re
import select
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
# First presses, one after the other; each step asks on the terminal before the next.
STEPS = """
import sys
from pathlib import Path
from types import SimpleNamespace

from rig.acquire.calibration.store import Calibration
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

for press in range(int(sys.argv[1])):
    print(f"press {press}")
    try:
        press_in_steps(bench, Calibration(), 1e-3, record, confirm)
        print("all pressed")
    except Interrupted as error:
        print(f"stopped: {error}")
"""


def at_a_terminal(presses: list[list[str]], ahead: str = "") -> list[str]:
    """Answer the questions of first presses in turn; return the terminal's text of each.

    `ahead` is typed before the program has started.
    """
    answers = [answer for press in presses for answer in press]
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(ROOT)
        os.environ["PYTHONPATH"] = str(ROOT)
        os.execv(sys.executable, [sys.executable, "-c", STEPS, str(len(presses))])
    os.write(terminal, ahead.encode())
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
    return re.split(r"press \d\r\n", shown)[1:]


def test_only_the_word_leads_to_the_next_step() -> None:
    others = ["\n", "q\n", "move it\n", "\x03", "\x04"]
    *stopped, whole = at_a_terminal([*(["move\n", other] for other in others), ["move\n"] * 12])
    for other, shown in zip(others, stopped, strict=True):
        assert "first press, air" in shown, other
        assert "next: " in shown, other
        assert "pressed 1" in shown, other
        assert "pressed 2" not in shown, other
        assert 'stopped: the answer was not "move"' in shown, other
    assert "all pressed" in whole
    assert whole.count("next: ") == whole.count("pressed ") - 1


def test_words_typed_ahead_answer_no_question() -> None:
    (shown,) = at_a_terminal([["\n"]], ahead="move\nmove\n" * 3)
    assert 'stopped: the answer was not "move"' in shown
    assert "pressed 2" not in shown
