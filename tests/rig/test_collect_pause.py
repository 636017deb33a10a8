"""Ctrl-C, pausing, the dead-man pedal and the watched grip, from rules to whole collections."""

import contextlib
import json
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import hidraw_nodes
from support.collecting import faults_of
from support.drivers import running
from support.waiting import until

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from recorder import OUTCOMES, Session
from rig.acquire.control import Control, Interrupted, InterruptFlag
from rig.core.clock import SystemClock
from rig.core.errors import DeviceLost
from rig.core.packaged import BENCHES
from rig.devices.gripper.robotiq import GripWatch, judge
from rig.devices.gripper.robotiq_emulator import Fingers, RobotiqEmulator
from rig.devices.gripper.robotiq_wire import AT_POSITION, MOVING, STOPPED_CLOSING, GripperStatus
from rig.devices.gripper.settings import RobotiqConfig

COMPLETE, INTERRUPTED = OUTCOMES.index("complete"), OUTCOMES.index("interrupted")


# Control.


def test_everybody_who_asked_for_a_pause_has_to_resume() -> None:
    control = Control()
    assert control.paused_by == ()
    control.pause("page")
    control.pause("foot pedal")
    control.pause("page")
    assert control.paused_by == ("foot pedal", "page")
    control.resume("page")
    assert control.paused_by == ("foot pedal",)
    control.resume("nobody")
    control.resume("foot pedal")
    assert control.paused_by == ()


def test_an_abort_names_who_asked_first_and_cannot_be_withdrawn() -> None:
    control = Control()
    control.check()
    control.abort("page")
    control.abort("foot pedal")
    control.resume("page")
    with pytest.raises(Interrupted, match="aborted by the page"):
        control.check()


# Ctrl-C: the first requests a stop, the second forces it; none while the session closes.


@pytest.fixture(autouse=True)
def unheeded_hang_up() -> Iterator[None]:
    """Undo nohup, under which the tests may run."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_the_first_is_remembered_and_told_when_asked(number: signal.Signals) -> None:
    with InterruptFlag() as flag:
        flag.check()
        signal.raise_signal(number)
        assert flag.requested
        with pytest.raises(Interrupted, match=r"by the operator|terminal was closed"):
            flag.check()


def test_the_second_does_not_wait() -> None:
    with InterruptFlag():
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_nothing_interrupts_the_closing() -> None:
    with InterruptFlag() as flag:
        flag.ignore()
        for _ in range(3):
            signal.raise_signal(signal.SIGINT)


def test_the_handlers_before_are_back_afterwards() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with InterruptFlag():
        assert signal.getsignal(signal.SIGINT) != before[0]
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_closing_terminal_may_say_so_several_times() -> None:
    with InterruptFlag() as flag:
        for _ in range(3):
            signal.raise_signal(signal.SIGHUP)
        with pytest.raises(Interrupted, match="the terminal was closed"):
            flag.check()


def test_under_nohup_a_closed_terminal_stops_nothing() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with InterruptFlag() as flag:
        signal.raise_signal(signal.SIGHUP)
        flag.check()


# The grip.

HOLDING = GripperStatus(True, True, 3, STOPPED_CLOSING, 0, 255, 120, 0.06)


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({}, None),
        ({"position": 124}, None),
        ({"position": 125}, "moved by +5"),
        ({"position": 115}, "moved by -5"),
        ({"object": AT_POSITION}, "object is gone"),
        ({"object": MOVING}, "fingers move"),
        ({"fault": 10}, "supply voltage"),
        ({"state": 0}, "not active"),
    ],
)
def test_a_grip_is_lost_for_a_reason(changed: dict[str, int], why: str | None) -> None:
    found = judge(replace(HOLDING, **changed), HOLDING, 4)
    assert (found is None) == (why is None)
    assert (why or "") in (found or "")


@pytest.fixture(name="gripper")
def emulated_gripper(tmp_path: Path) -> Iterator[RobotiqEmulator]:
    clock = SystemClock()
    fingers = Fingers(clock, object_at=120, holding=True)
    with running(RobotiqEmulator(fingers, tmp_path / "gripper.tty", clock)) as emulator:
        yield emulator


@pytest.fixture(name="watch")
def watching(gripper: RobotiqEmulator) -> Iterator[GripWatch]:
    # The emulator shares the cores, so it may answer late.
    config = RobotiqConfig(gripper.address, rate_hz=100.0, answer=0.4, silence=1.5)
    watch = GripWatch(config, SystemClock(), lambda: None)
    yield watch
    watch.close()
    watch.close()


@pytest.mark.parametrize(
    ("fault", "values", "why"),
    [
        ("lose_grip", {}, "grip lost"),
        ("slip", {"counts": 6}, "moved by +6"),
        ("fail", {"code": 10}, "supply voltage"),
        ("freeze", {}, "no good answer"),
        ("garbage", {}, "no good answer"),
        ("unplug", {}, "no good answer"),
    ],
)
def test_a_watched_grip_is_lost_whatever_way(
    fault: str, values: dict[str, int], why: str, gripper: RobotiqEmulator, watch: GripWatch
) -> None:
    assert watch.open(2.0)["position"] == 120
    until(lambda: watch.polls > 3)
    assert watch.lost is None
    gripper.inject(fault, **values)
    until(lambda: watch.lost is not None)
    assert why in (watch.lost or "")


def test_one_corrupt_answer_is_no_lost_grip(gripper: RobotiqEmulator, watch: GripWatch) -> None:
    watch.open(2.0)
    gripper.inject("garbage", messages=1)
    seen = watch.polls
    until(lambda: watch.polls > seen + 5)
    assert watch.lost is None


def test_a_gripper_that_holds_nothing_does_not_pass_the_preflight(
    gripper: RobotiqEmulator, watch: GripWatch
) -> None:
    gripper.inject("lose_grip")
    with pytest.raises(DeviceLost, match="does not hold the indenter"):
        watch.open(2.0)


# The interlocks, with the real hidapi on an emulated pedal.

INTERLOCKS = """
import json, select, sys
from dataclasses import replace
from pathlib import Path
from rig.acquire.control import Control
from rig.acquire.control import DeadManReleased, Interlocks
from rig.bench.bench import BenchFile
from rig.core.clock import SystemClock
from rig.core.errors import DeviceLost
from rig.devices.hid.hid_emulator import HidEmulator
from rig.devices.hid.settings import PedalConfig

node, mode, bench_file = sys.argv[1:]
clock, control = SystemClock(), Control()
emulator = HidEmulator("pedal", Path(node), clock)
emulator.start()
bench = BenchFile.read(Path(bench_file)).bench
bench = replace(bench, pedal=PedalConfig(node, mode=mode, unplugged_limit=1.0))
seen = []
def look():
    found = []
    try:
        interlocks.check(pressing=True)
    except (DeadManReleased, DeviceLost) as error:
        found.append(f"{type(error).__name__}: {error}")
    return [*found, interlocks.armed(), interlocks.wish, list(control.paused_by)]
def do(fault):
    emulator.inject(fault)
    select.select([interlocks.wake], [], [])
    seen.append([fault, *look()])
with Interlocks(bench, control, clock) as interlocks:
    properties = interlocks.open()
    while not emulator.inject("state")["clients"]:
        clock.sleep_until(clock.now_ns() + 5_000_000)
    seen.append(["begin", *look()])
    for fault in ("press", "release", "press", "unplug"):
        do(fault)
    clock.sleep_until(clock.now_ns() + 1_300_000_000)
    seen.append(["later", *look()])
    do("replug")
    while not emulator.inject("state")["clients"]:
        clock.sleep_until(clock.now_ns() + 5_000_000)
    do("press")
emulator.close()
print(json.dumps({"seen": seen, "properties": properties}))
"""
HOLD, LET_GO = "press and hold the foot pedal", "let go of the foot pedal, then press and hold it"
RELEASED = "DeadManReleased: the foot pedal was released"
UNPLUGGED = "DeadManReleased: the foot pedal was unplugged"


def interlocks_saw(folder: Path, mode: str) -> dict[str, list[object]]:
    words = (str(folder / "pedal.hidraw"), mode, str(BENCHES / "tacpalm.yaml"))
    found = json.loads(hidraw_nodes.run(hidraw_nodes.library(folder), INTERLOCKS, *words))
    assert found["properties"]["pedal"]["mode"] == mode
    seen = {name: rest for name, *rest in found["seen"][:-1]}
    return seen | {"again": found["seen"][-1][1:], "first press": found["seen"][1][1:]}


@pytest.mark.slow
def test_a_dead_man_pedal_arms_by_a_press_and_says_what_it_waits_for(tmp_path: Path) -> None:
    seen = interlocks_saw(tmp_path, "dead_man")
    assert seen["begin"] == [RELEASED, False, HOLD, []]
    # The check right after a press still finds it unarmed; the query arms it.
    assert seen["first press"] == [RELEASED, True, LET_GO, []]
    assert seen["release"] == [RELEASED, False, HOLD, []]
    assert seen["unplug"][:2] == [UNPLUGGED, False]
    assert "plug it in" in str(seen["unplug"][2])
    assert "unplugged for" in str(seen["later"][0])
    assert str(seen["later"][0]).startswith("DeviceLost")
    assert seen["replug"] == [RELEASED, False, HOLD, []]
    assert seen["again"][1] is True


@pytest.mark.slow
def test_a_pause_pedal_toggles_the_pause_and_asks_for_one_when_it_is_taken_out(
    tmp_path: Path,
) -> None:
    seen = interlocks_saw(tmp_path, "pause")
    assert seen["begin"][-1] == []
    assert seen["first press"][-1] == ["foot pedal"]
    assert seen["release"][-1] == ["foot pedal"]
    assert seen["unplug"][-1] == ["foot pedal"]
    assert str(seen["later"][0]).startswith("DeviceLost")
    assert seen["replug"][-1] == ["foot pedal"]
    assert seen["again"][-1] == []


# Whole collections.

MORE = """
gripper: {{kind: robotiq_2f, port: runfolder/gripper.tty}}
pedal:
  kind: hid_pedal
  device: runfolder/pedal.hidraw
  mode: {mode}
  unplugged_limit_s: {limit}
"""
WHOLE = [(phase, COMPLETE) for phase in range(4)]
WAITS = f"waiting: {HOLD}"
Collect = Callable[..., CollectionRun]


@pytest.fixture(name="collect")
def collecting_here(tmp_path: Path) -> Iterator[Collect]:
    """Start collections of two targets with a gripper and a pedal, and wait for the first phase."""
    with contextlib.ExitStack() as stack:

        def collect(mode: str, limit: float = 60.0, targets: int = 2) -> CollectionRun:
            quick_bench(tmp_path, "tacpalm", more=MORE.format(mode=mode, limit=limit))
            bench = tmp_path / "slow.yaml"
            bench.write_text("extends: bench.yaml\narm: {speed_mm_s: 2.0}\n")
            words = ("--bench", str(bench), "--targets", str(targets))
            shim = hidraw_nodes.library(tmp_path)
            run = CollectionRun.collect(tmp_path / "s.zarr", *words, preload=shim)
            stack.enter_context(run).until_recording()
            if mode == "dead_man":
                hold(run)
            run.until_pressing()
            return run

        yield collect


def hold(run: CollectionRun) -> None:
    run.until_said(WAITS)
    run.tell("pedal", "press")


def rows(session: Path) -> list[tuple[int, int, int]]:
    """Return target, phase and outcome of the phases so far."""
    segments = Session(session).segments
    columns = (segments[name] for name in ("target", "phase", "outcome"))
    return [(int(a), int(b), int(c)) for a, b, c in zip(*columns, strict=True)]


@pytest.mark.serial
@pytest.mark.slow
def test_a_pause_waits_clear_of_the_surface_and_ctrl_c_ends_the_next(collect: Collect) -> None:
    run = collect("pause", targets=3)
    run.tell("pedal", "press")
    run.tell("pedal", "release")
    run.until_said("paused by the foot pedal")
    SystemClock().sleep_until(SystemClock().now_ns() + 2_000_000_000)
    run.tell("pedal", "press")
    run.until_said("continuing after a pause")
    run.tell("pedal", "release")
    run.tell("pedal", "press")
    run.until_said("paused by the foot pedal", after="continuing after a pause")
    os.killpg(run.process.pid, signal.SIGINT)
    assert run.wait(240) == 130, run.text
    session = Session(run.session)
    assert session.status == "stopped"
    # Only before the next target: the current one was finished.
    assert [row[1:] for row in rows(run.session)] == WHOLE * 2
    assert faults_of(run.session, stopped=True) == []
    segments, pose = session.segments, session.streams["pose"]
    gaps = (segments["start_ns"][1:] - segments["end_ns"][:-1]) / 1e9
    assert gaps[3] > 2.0
    assert gaps.argmax() == 3
    paused = (pose.t_ns > segments["end_ns"][3]) & (pose.t_ns < segments["start_ns"][4])
    heights = np.asarray(pose.array("value"))[paused, 2] - session.attrs["contact_frame"][2]
    assert paused.sum() > 500
    assert heights.min() > 0.0


@pytest.mark.serial
@pytest.mark.slow
def test_a_pedal_released_or_unplugged_in_mid_shear_halts_and_the_target_is_pressed_again(
    collect: Collect,
) -> None:
    run = collect("dead_man")
    # The shear takes 0.8 s at this speed.
    SystemClock().sleep_until(SystemClock().now_ns() + 150_000_000)
    released_ns = SystemClock().now_ns()
    run.tell("pedal", "release")
    run.until_said(WAITS, after="halted: the foot pedal was released")
    run.tell("pedal", "press")
    run.until(lambda: len(rows(run.session)) > 2, "the target pressed again")
    run.tell("pedal", "unplug")
    run.until_said("the foot pedal is unplugged: plug it in")
    run.tell("pedal", "replug")
    run.until_said(WAITS, after="the foot pedal is back")
    run.until(lambda: bool(run.tell("pedal", "state")["clients"]), "the pedal read again")
    run.tell("pedal", "press")
    assert run.wait(240) == 0, run.text
    session = Session(run.session)
    assert session.status == "complete"
    *broken, last = [place for place, row in enumerate(rows(run.session)) if row[2] == INTERRUPTED]
    assert broken == [1]
    assert rows(run.session)[:2] == [(0, 0, COMPLETE), (0, 1, INTERRUPTED)]
    assert rows(run.session)[last + 1 :] == [(each, *row) for each in (0, 1) for row in WHOLE]
    assert faults_of(run.session) == []
    # The contact point has another reference, taken before it was pressed again.
    assert list(session.reference["point"]) == [1, 1, 1]
    pose, segments = session.streams["pose"], session.segments
    place = np.asarray(pose.array("value"))[:, :3]
    before = np.diff(place[pose.t_ns <= released_ns][-10:, :2], axis=0) / 0.002
    assert np.linalg.norm(before, axis=1).min() > 1e-3  # it was shearing
    waiting = (pose.t_ns > segments["end_ns"][1]) & (pose.t_ns < segments["start_ns"][2])
    assert place[waiting, 2].max() - session.attrs["contact_frame"][2] > 0.015


@pytest.mark.serial
@pytest.mark.slow
def test_an_unplugged_dead_man_pedal_halts_and_is_lost_after_its_limit(collect: Collect) -> None:
    run = collect("dead_man", limit=8.0)
    run.tell("pedal", "unplug")
    run.until_said("halted: the foot pedal was unplugged")
    run.until_said("the foot pedal is unplugged: plug it in")
    assert run.wait(240) == 3, run.text
    session = Session(run.session)
    assert "unplugged for" in session.attrs["reason"]
    assert "NOT RETRACTED" not in session.attrs["reason"]
    assert rows(run.session)[-1][2] == INTERRUPTED
    assert faults_of(run.session, stopped=True) == []
