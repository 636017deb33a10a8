"""Jogging: the motion requested by the cap, and the arm of a mock bench moved by hand."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from support import hidraw_nodes

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from rig.acquire.setup_checks import origin_text
from rig.bench.bench import BenchFile
from rig.cli.jog import REACH, planned
from rig.core.packaged import BENCHES
from tactile.__main__ import main

BOX = ((-0.01, -0.01, -0.0047), (0.01, 0.01, 0.06))
parts = st.floats(-1.0, 1.0)
shifts = st.tuples(parts, parts, parts)
places = st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01), st.floats(-0.0047, 0.06))


@given(shifts, places)
def test_a_jog_stays_in_the_box_and_below_the_speed_and_reaches_no_further(shift, tip) -> None:
    step = planned(shift, tip, BOX, 0.005)
    if step is None:
        return
    goal, speed = step
    assert all(low <= x <= high for x, low, high in zip(goal, *BOX, strict=True))
    assert 0 < speed <= 0.005 * (1 + 1e-9)
    assert np.linalg.norm(np.subtract(goal, tip)) <= 0.005 * REACH * (1 + 1e-9)


def test_half_the_deflection_is_half_the_speed_and_a_corner_is_no_faster_than_an_edge() -> None:
    half = planned((0.5, 0.0, 0.0), (0.0, 0.0, 0.01), BOX, 0.004)
    corner = planned((1.0, 1.0, 1.0), (0.0, 0.0, 0.01), BOX, 0.004)
    assert half == ((pytest.approx(0.002), 0.0, 0.01), pytest.approx(0.002))
    assert corner is not None
    assert corner[1] == pytest.approx(0.004)


def test_against_the_wall_of_the_box_or_let_go_of_it_stays() -> None:
    assert planned((1.0, 0.0, 0.0), (0.01, 0.0, 0.01), BOX, 0.005) is None
    assert planned((0.0, 0.0, -1.0), (0.0, 0.0, -0.0047), BOX, 0.005) is None
    assert planned((0.0, 0.0, 0.0), (0.0, 0.0, 0.01), BOX, 0.005) is None


def test_the_origin_is_printed_as_a_bench_file_takes_it() -> None:
    bench = BenchFile.read(BENCHES / "tacpalm.yaml").bench
    text = origin_text(bench, (0.001, -0.002, 0.0005))
    snippet = yaml.safe_load(text[text.index("contact_frame:") : text.index("then")])
    assert snippet["contact_frame"] == {
        "position_mm": pytest.approx([-119.0, -432.0, 160.5]),
        "rotation_deg": [0.0, 0.0, 0.0],
    }


def test_a_bench_without_a_spacemouse_is_wrong_input(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["jog", "--bench", str(BENCHES / "tacpalm.yaml")]) == 2
    assert "jog: missing" in capfd.readouterr().err


# On the mock bench.


class Hand:
    """A running `tactile jog` and a simulated hand on its emulated SpaceMouse."""

    def __init__(self, folder: Path) -> None:
        jog = "jog: {kind: spacemouse, device: runfolder/cap.hidraw, speed_max_mm_s: 5.0}"
        bench = quick_bench(folder, "tacpalm", more=jog)
        shim = hidraw_nodes.library(folder)
        self.run = CollectionRun(folder / "none", "jog", "--bench", str(bench), preload=shim)
        self.run.until_said("Ctrl-C ends")
        self.run.until_bench()
        self.start = self.place()

    def wait(self, condition: Callable[[], bool]) -> None:
        self.run.until(condition, "what the hand does")

    def ends(self, code: int) -> str:
        """Wait for its end with this exit code; return what it printed."""
        assert self.run.wait() == code, self.run.text
        return self.run.text

    def move(self, fault: str, **values: float) -> None:
        self.run.tell("spacemouse", fault, **values)

    def place(self) -> np.ndarray:
        return np.array(self.run.tell("arm", "state")["pose"][:3])

    def moving(self) -> bool:
        speed = self.run.tell("arm", "state")["speed"]
        return bool(np.linalg.norm(speed[:3]) > 1e-4)


@pytest.fixture(name="hand")
def jogging(tmp_path: Path) -> Iterator[Hand]:
    hand = Hand(tmp_path)
    with hand.run:
        yield hand


@pytest.mark.serial
@pytest.mark.slow
def test_the_arm_follows_the_cap_stops_with_it_and_a_button_takes_the_origin(hand: Hand) -> None:
    hand.move("push", x=1.0, seconds=1.0)
    hand.wait(hand.moving)
    hand.wait(lambda: not hand.moving())
    moved = hand.place() - hand.start
    # 5 mm/s for a second, plus the time to notice that the cap fell silent.
    assert 0.002 < moved[0] < 0.0085
    assert np.abs(moved[1:]).max() < 1e-4
    hand.move("push", z=-1.0, seconds=1.0)
    hand.wait(hand.moving)
    hand.wait(lambda: not hand.moving())
    taken = hand.place()
    assert taken[2] < hand.start[2] - 0.002
    hand.move("button", number=0)
    text = hand.ends(0)
    snippet = yaml.safe_load(text[text.index("contact_frame:") : text.index("then find")])
    assert snippet["contact_frame"]["position_mm"] == pytest.approx(1e3 * taken, abs=0.1)


@pytest.mark.serial
@pytest.mark.slow
def test_an_unplugged_cap_stops_the_arm_and_ends_with_3(hand: Hand) -> None:
    hand.move("push", y=-1.0, seconds=30.0)
    hand.wait(hand.moving)
    hand.move("unplug")
    assert "is it plugged in" in hand.ends(3)


@pytest.mark.serial
@pytest.mark.slow
def test_pushed_into_the_wall_the_tip_stays_inside_and_ctrl_c_stops_the_arm(hand: Hand) -> None:
    hand.move("push", x=1.0, seconds=6.0)
    hand.wait(hand.moving)
    hand.wait(lambda: (hand.place() - hand.start)[0] > 0.0095 and not hand.moving())
    assert (hand.place() - hand.start)[0] < 0.0102
    hand.move("push", x=-1.0, seconds=30.0)
    hand.wait(hand.moving)
    hand.run.process.send_signal(signal.SIGINT)
    hand.ends(130)
