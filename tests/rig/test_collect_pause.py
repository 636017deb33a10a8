"""Pausing, the dead-man pedal and the monitored grip, from the rules to whole collections."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import hidraw_nodes
from support.collecting import Collection, faults_of

from recorder import OUTCOMES, Session
from rig.acquire.control import Control, Interrupted
from rig.core import emulation
from rig.core.clock import SystemClock
from rig.core.errors import DeviceLost
from rig.core.mock_names import PORTS
from rig.core.packaged import BENCHES
from rig.devices.gripper.robotiq import GripWatch, judge
from rig.devices.gripper.robotiq_emulator import Fingers, RobotiqEmulator
from rig.devices.gripper.robotiq_wire import AT_POSITION, MOVING, STOPPED_CLOSING, GripperStatus
from rig.devices.gripper.settings import RobotiqConfig

ROOT = Path(__file__).parents[2]
COMPLETE, INTERRUPTED, STOPPED = (
    OUTCOMES.index(name) for name in ("complete", "interrupted", "stopped")
)


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
    emulator = RobotiqEmulator(
        Fingers(clock, object_at=120, holding=True), tmp_path / "gripper.tty", clock
    )
    emulator.start()
    yield emulator
    emulator.close()


@pytest.fixture(name="watch")
def watching(gripper: RobotiqEmulator) -> Iterator[GripWatch]:
    # The emulator shares the cores, so it may answer late.
    config = RobotiqConfig(gripper.address, rate_hz=100.0, answer=0.4, silence=1.5)
    watch = GripWatch(config, SystemClock(), lambda: None)
    yield watch
    watch.close()
    watch.close()


def wait_until(condition: Callable[[], bool], seconds: float = 240.0) -> None:
    clock = SystemClock()
    limit_ns = clock.now_ns() + round(seconds * 1e9)
    while not condition():
        assert clock.now_ns() < limit_ns, "did not come about"
        clock.sleep_until(clock.now_ns() + 5_000_000)


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
    description = watch.open(2.0)
    assert description["position"] == 120
    wait_until(lambda: watch.polls > 3)
    assert watch.lost is None
    gripper.inject(fault, **values)
    wait_until(lambda: watch.lost is not None)
    assert why in (watch.lost or "")


def test_one_corrupt_answer_is_no_lost_grip(gripper: RobotiqEmulator, watch: GripWatch) -> None:
    watch.open(2.0)
    gripper.inject("garbage", messages=1)
    seen = watch.polls
    wait_until(lambda: watch.polls > seen + 5)
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
seen, delays = [], []
def look():
    found = []
    try:
        interlocks.check(pressing=True)
    except (DeadManReleased, DeviceLost) as error:
        found.append(f"{type(error).__name__}: {error}")
    return [*found, interlocks.armed(), interlocks.wish, list(control.paused_by)]
def do(fault):
    began_ns = clock.now_ns()
    emulator.inject(fault)
    while not select.select([interlocks.wake], [], [], 5.0)[0]:
        raise SystemExit(f"{fault}: nobody was woken")
    delays.append((clock.now_ns() - began_ns) / 1e6)
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
print(json.dumps({"seen": seen, "delays": delays, "properties": properties}))
"""
HOLD, LET_GO = "press and hold the foot pedal", "let go of the foot pedal, then press and hold it"
RELEASED = "DeadManReleased: the foot pedal was released"
UNPLUGGED = "DeadManReleased: the foot pedal was unplugged"


def interlocks_saw(folder: Path, mode: str) -> dict[str, list[object]]:
    bench = BENCHES / "tacpalm.yaml"
    text = hidraw_nodes.run(
        hidraw_nodes.library(folder), INTERLOCKS, str(folder / "pedal.hidraw"), mode, str(bench)
    )
    found = json.loads(text)
    print(f"from the foot to waking the runner: {[round(ms, 1) for ms in found['delays']]} ms")
    assert found["properties"]["pedal"]["mode"] == mode
    seen = {name: rest for name, *rest in found["seen"][:-1]}
    return seen | {"again": found["seen"][-1][1:], "first press": found["seen"][1][1:]}


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

BENCH = """
extends: {root}/rig/bench/benches/tacpalm.yaml
preflight: {{rate_window: 0.4, tare_window: 0.2, point_window: 0.1}}
arm: {{speed_mm_s: 2.0, travel_speed_mm_s: 100.0, travel_acceleration_mm_s2: 1000.0}}
gripper: {{kind: robotiq_2f, port: runfolder/gripper.tty}}
"""
PEDAL = """
pedal:
  kind: hid_pedal
  device: runfolder/pedal.hidraw
  mode: {mode}
  unplugged_limit_s: {limit}
"""


Collect = Callable[..., Collection]


@pytest.fixture(name="collect")
def collecting_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Collect]:
    """Start collections on a bench with a gripper and a pedal in `mode`; end them afterwards."""
    runs: list[Collection] = []

    def collect(targets: int, mode: str = "", unplugged_limit: float = 60.0) -> Collection:
        text = BENCH.format(root=ROOT)
        if mode:
            monkeypatch.setenv("LD_PRELOAD", str(hidraw_nodes.library(tmp_path)))
            text += PEDAL.format(mode=mode, limit=unplugged_limit)
        bench = tmp_path / "bench.yaml"
        bench.write_text(text)
        run = Collection.start(
            tmp_path / "s.zarr", "--bench", str(bench), "--targets", str(targets)
        )
        monkeypatch.delenv("LD_PRELOAD", raising=False)
        runs.append(run)
        return run

    yield collect
    for run in runs:
        if run.process.returncode is None:
            run.kill_all()
            run.process.communicate()


def inject(run: Collection, device: str, fault: str, **values: float) -> int:
    """Inject a fault and return the time just before [ns of the monotonic clock]."""
    host = run.host()
    now_ns = SystemClock().now_ns()
    emulation.inject(host, PORTS[device], fault, **values)
    return now_ns


def wait_for_log(run: Collection, words: str) -> None:
    log = run.session.with_suffix(".log")
    run.until(lambda: log.exists() and words in log.read_text())


def rows(session: Path) -> list[tuple[int, int, int]]:
    """Return target, phase and outcome of the phases so far."""
    segments = Session(session).segments
    columns = (segments[name] for name in ("target", "phase", "outcome"))
    return [(int(a), int(b), int(c)) for a, b, c in zip(*columns, strict=True)]


def in_second_phase(run: Collection) -> None:
    """Wait until the first phase is stored: the arm is about to move sideways."""
    run.until(run.recording)
    run.until(lambda: run.segments() > 0)


WHOLE = [(phase, COMPLETE) for phase in range(4)]


@pytest.mark.serial
@pytest.mark.slow
def test_a_pause_waits_clear_of_the_surface_and_leaves_a_clean_session(collect: Collect) -> None:
    run = collect(2, "pause")
    in_second_phase(run)
    inject(run, "pedal", "press")
    inject(run, "pedal", "release")
    wait_for_log(run, "paused by the foot pedal")
    SystemClock().sleep_until(SystemClock().now_ns() + 2_000_000_000)
    inject(run, "pedal", "press")
    assert run.wait() == 0, run.text
    session = Session(run.session)
    assert [row[1:] for row in rows(run.session)] == WHOLE * 2
    assert faults_of(run.session) == []
    segments = session.segments
    pose = session.streams["pose"]
    # Only before the next target: the current one was finished.
    gaps = (segments["start_ns"][1:] - segments["end_ns"][:-1]) / 1e9
    assert gaps[3] > 2.0
    assert gaps.argmax() == 3
    paused = (pose.t_ns > segments["end_ns"][3]) & (pose.t_ns < segments["start_ns"][4])
    heights = np.asarray(pose.array("value"))[paused, 2] - session.attrs["contact_frame"][2]
    assert paused.sum() > 500
    assert heights.min() > 0.0
    assert "continuing after a pause" in run.text


@pytest.mark.serial
@pytest.mark.slow
def test_ctrl_c_ends_a_pause_with_everything_kept(collect: Collect) -> None:
    run = collect(2, "pause")
    in_second_phase(run)
    inject(run, "pedal", "press")
    wait_for_log(run, "paused by the foot pedal")
    os.killpg(run.process.pid, signal.SIGINT)
    assert run.wait() == 130, run.text
    assert Session(run.session).status == "stopped"
    assert faults_of(run.session, stopped=True) == []


@pytest.mark.serial
@pytest.mark.slow
def test_a_pedal_released_in_mid_shear_halts_and_the_target_is_pressed_again(
    collect: Collect,
) -> None:
    run = collect(2, "dead_man")
    run.until(run.recording)
    wait_for_log(run, "waiting: press and hold the foot pedal")
    inject(run, "pedal", "press")
    in_second_phase(run)
    # The shear takes 0.8 s at this speed.
    SystemClock().sleep_until(SystemClock().now_ns() + 150_000_000)
    released_ns = inject(run, "pedal", "release")
    wait_for_log(run, "halted: the foot pedal was released")
    run.until(lambda: "waiting: press" in last_part(run, "halted"))
    inject(run, "pedal", "press")
    assert run.wait() == 0, run.text
    session = Session(run.session)
    assert session.status == "complete"
    first, again = rows(run.session)[:2], rows(run.session)[2:]
    assert first == [(0, 0, COMPLETE), (0, 1, INTERRUPTED)]
    assert again == [(target, *row) for target in (0, 1) for row in WHOLE]
    assert faults_of(run.session) == []
    # The contact point has a second reference, taken before it was pressed again.
    assert list(session.reference["point"]) == [1, 1]
    pose, segments = session.streams["pose"], session.segments
    place = np.asarray(pose.array("value"))[:, :3]
    after = np.flatnonzero(pose.t_ns > released_ns)
    moved = np.linalg.norm(np.diff(place[after], axis=0), axis=1) / 0.002
    before = np.diff(place[pose.t_ns <= released_ns][-10:, :2], axis=0) / 0.002
    assert np.linalg.norm(before, axis=1).min() > 1e-3  # it was shearing
    stood_ns = int(pose.t_ns[after[np.flatnonzero(moved < 1e-4)[0]]])
    print(f"noticed {(segments['end_ns'][1] - released_ns) / 1e6:.1f} ms after the release")
    print(f"stood still {(stood_ns - released_ns) / 1e6:.1f} ms after it")
    frame = session.attrs["contact_frame"][2]
    waiting = (pose.t_ns > segments["end_ns"][1]) & (pose.t_ns < segments["start_ns"][2])
    assert place[waiting, 2].max() - frame > 0.015


def last_part(run: Collection, word: str) -> str:
    """Return the log from the last `word` on."""
    return run.session.with_suffix(".log").read_text().rpartition(word)[2]


@pytest.mark.serial
@pytest.mark.slow
def test_an_unplugged_dead_man_pedal_halts_and_is_lost_after_its_limit(collect: Collect) -> None:
    run = collect(2, "dead_man", 8.0)
    run.until(run.recording)
    wait_for_log(run, "waiting: press and hold")
    inject(run, "pedal", "press")
    in_second_phase(run)
    inject(run, "pedal", "unplug")
    wait_for_log(run, "halted: the foot pedal was unplugged")
    wait_for_log(run, "the foot pedal is unplugged: plug it in")
    assert run.wait() == 3, run.text
    session = Session(run.session)
    assert "unplugged for" in session.attrs["reason"]
    assert "NOT RETRACTED" not in session.attrs["reason"]
    assert rows(run.session)[-1][2] == INTERRUPTED
    assert faults_of(run.session, stopped=True) == []


@pytest.mark.serial
@pytest.mark.slow
def test_a_pedal_plugged_in_again_in_time_goes_on(collect: Collect) -> None:
    run = collect(1, "dead_man")
    run.until(run.recording)
    wait_for_log(run, "waiting: press and hold")
    inject(run, "pedal", "press")
    in_second_phase(run)
    inject(run, "pedal", "unplug")
    wait_for_log(run, "the foot pedal is unplugged: plug it in")
    inject(run, "pedal", "replug")
    wait_for_log(run, "the foot pedal is back")
    inject(run, "pedal", "press")
    assert run.wait() == 0, run.text
    assert rows(run.session)[-4:] == [(0, *row) for row in WHOLE]
    assert faults_of(run.session) == []
