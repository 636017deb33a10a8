"""The real ur_rtde in its supervised child, against the emulator in a process of its own."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from rig.core.clock import SECOND_NS, SystemClock
from rig.core.errors import DeviceLost, SafetyStop
from rig.core.geometry import compose
from rig.core.guard import GuardLimits
from rig.core.samples import FORCE_LATEST
from rig.core.shared_memory import LatestRecord
from rig.devices.arm import emulator_faults
from rig.devices.arm.arm import Arm
from rig.devices.arm.emulated_arm import CYCLE, POSTURE, flange_pose
from rig.devices.arm.reader import RtdePoseDriver
from rig.devices.arm.settings import ArmConfig

pytestmark = pytest.mark.serial


pytest.importorskip("rtde_control", reason="no ur-rtde: pip install 'tactile-rig[rig]'")

ROOT = Path(__file__).resolve().parents[2]
HOST = f"127.{110 + os.getpid() // 250 % 100}.{1 + os.getpid() % 250}.1"
TCP = (0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
START = compose(flange_pose(np.array(POSTURE)), TCP)
FRAME = (*(START[:3] - [0.0, 0.0, 0.03]), 0.0, 0.0, 0.0)
LIMITS = GuardLimits(
    force_rating=(10.0, 10.0, 10.0, 1.0, 1.0, 1.0),
    box=((-0.05, -0.05, -0.005), (0.05, 0.05, 0.06)),
    # Roomy: the machine's own delays must not look like a lost sensor.
    stale_force=2.0,
    stale_pose=2.0,
)
CONFIG = ArmConfig(host=HOST, tcp=TCP, payload=0.7, retract=0.01, watchdog_hz=4.0)
PLAYING = 2
CLOCK = SystemClock()


def inject(fault: str = "state", **values: Any) -> dict[str, Any]:
    return emulator_faults.inject(HOST, fault, **values)


def at(x: float, y: float, z: float, vector=START[3:]) -> np.ndarray:
    """TCP pose at a place in the contact frame, which stands parallel to the base."""
    return np.array([FRAME[0] + x, FRAME[1] + y, FRAME[2] + z, *vector])


def height() -> float:
    return inject()["pose"][2] - FRAME[2]


def wait_until(condition: Callable[[], bool], seconds: float = 20.0) -> None:
    deadline_ns = CLOCK.now_ns() + round(seconds * SECOND_NS)
    while not condition():
        assert CLOCK.now_ns() < deadline_ns, "did not come about"
        CLOCK.sleep_until(CLOCK.now_ns() + 10_000_000)


def moving() -> bool:
    return any(abs(speed) > 1e-3 for speed in inject()["speed"])


def stands_still() -> bool:
    """The same pose over at least 50 controller cycles."""
    before = inject()
    wait_until(lambda: inject()["tick"] >= before["tick"] + 50)
    return inject()["pose"] == before["pose"]


def child() -> int:
    (process,) = multiprocessing.active_children()
    assert process.pid is not None
    return process.pid


@pytest.fixture
def emulator() -> Iterator[subprocess.Popen[str]]:
    command = [
        sys.executable,
        "-m",
        "rig.devices.arm.emulator",
        "--host",
        HOST,
        "--until-stdin-closes",
    ]
    command += ["--pose", *map(repr, START.tolist()), "--tcp", *map(repr, TCP)]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == f"ready arm {HOST}\n"
        yield process
        process.kill()


def make(**options: Any) -> Arm:
    return Arm(
        options.pop("config", CONFIG),
        FRAME,
        options.pop("limits", LIMITS),
        force_path=options.pop("force_path", None),
        pose_path=options.pop("pose_path", None),
    )


@pytest.fixture
def arm(emulator) -> Iterator[Arm]:
    arm = make()
    arm.start(20.0)
    yield arm
    arm.close()
    arm.close()


class Once:
    """An `on_wait` that acts once, as soon as the arm moves."""

    def __init__(self, action: Callable[[], object]) -> None:
        self._action = action
        self.done = False

    def __call__(self) -> None:
        if not self.done and moving():
            self.done = True
            self._action()


def test_a_sequence_of_moves_reaches_every_pose_while_no_pose_is_missed(arm):
    driver = RtdePoseDriver(HOST, 500.0, CLOCK)
    driver.open(5.0)
    places = [(0, 0, 0.02), (0.01, 0, 0.02), (0.01, -0.01, 0.01), (0, 0, 0.03)]
    tilted = compose([0, 0, 0, 0.02, -0.03, 0.1], [0, 0, 0, *START[3:]])[3:]
    poses = [at(*place) for place in places] + [at(0, 0, 0.03, tilted)]
    samples, end_ns = [], 0
    for pose in poses:
        result = arm.move(pose, mode="travel")
        samples += driver.read(1.0)
        assert result.outcome == "done", result.reason
        assert end_ns <= result.start_ns < result.end_ns
        end_ns = result.end_ns
        assert_allclose(samples[-1]["value"][:3], pose[:3], atol=2e-4)
        assert_allclose(inject()["pose"], pose, atol=1e-6)
    ticks = [round(sample["device_t"] / CYCLE) for sample in samples]
    assert ticks == list(range(ticks[0], ticks[0] + len(ticks)))
    assert driver.dropped == 0
    driver.close()


def test_start_sets_tool_and_payload_and_close_stops_the_program(emulator):
    arm = make()
    assert not arm.alive
    arm.start(20.0)
    assert arm.alive
    state = inject()
    assert state["tcp"] == pytest.approx(TCP)
    assert state["payload"] == CONFIG.payload
    assert state["runtime_state"] == PLAYING
    arm.close()
    assert not arm.alive
    assert inject()["reason"] == "end of program"


def test_halt_stops_a_move_that_was_interrupted(arm):
    with pytest.raises(KeyboardInterrupt):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: signal.raise_signal(signal.SIGINT)))
    arm.halt()
    assert stands_still()
    assert 0.001 < height() < 0.03
    assert arm.move(at(0, 0, 0.03), mode="travel").outcome == "done"


def test_halt_from_another_thread_ends_the_move_as_stopped(arm):
    threads: list[threading.Thread] = []

    def halt() -> None:
        threads.append(threading.Thread(target=arm.halt))
        threads[0].start()

    result = arm.move(at(0, 0, 0), on_wait=Once(halt))
    threads[0].join()
    assert result.outcome == "stopped"
    assert "operator" in result.reason
    assert height() > 0.001


def test_retract_leaves_along_z_up_to_the_top_of_the_box(arm):
    assert arm.move(at(0.01, 0, 0.02), mode="travel").outcome == "done"
    assert arm.retract()
    assert_allclose(inject()["pose"], at(0.01, 0, 0.03), atol=1e-6)
    assert arm.move(at(0.01, 0, 0.055), mode="travel").outcome == "done"
    assert arm.retract()
    assert height() == pytest.approx(0.06)


def test_a_target_outside_the_box_is_refused_before_anything_moves(arm):
    with pytest.raises(SafetyStop, match=r"target: .* z = -6\.00 mm"):
        arm.move(at(0, 0, -0.006))
    assert inject()["pose"] == pytest.approx(START.tolist())
    assert arm.move(at(0, 0, 0.029)).outcome == "done"


def test_a_slow_slider_is_waited_for(arm):
    inject("slider", fraction=0.2)
    assert arm.move(at(0, 0, 0.02), mode="travel").outcome == "done"


def test_a_slider_turned_down_in_mid_move_ends_it_in_bounded_time(arm):
    result = arm.move(
        at(0, 0, 0.02), mode="travel", on_wait=Once(lambda: inject("slider", fraction=0.001))
    )
    assert result.outcome == "stopped"
    assert "slider" in result.reason


def push(record: LatestRecord, load: float, *, status: int = 0, age: float = 0.0) -> None:
    record.write((CLOCK.now_ns() - round(age * SECOND_NS), status, (0, 0, -load, 0, 0, 0)))


@pytest.fixture
def force(tmp_path) -> Iterator[LatestRecord]:
    record = LatestRecord.create(tmp_path / "force", FORCE_LATEST)
    push(record, 0.0)
    yield record
    record.close()


@pytest.fixture
def feeling(emulator, force, tmp_path) -> Iterator[Arm]:
    """An arm with an F/T sensor whose force the test writes."""
    arm = make(force_path=tmp_path / "force")
    arm.start(20.0)
    yield arm
    arm.close()


def test_the_soft_limit_ends_a_press_which_can_be_left(feeling, force):
    def press() -> None:
        push(force, 0.9 * 10.0 if height() < 0.02 else 1.0)

    result = feeling.move(at(0, 0, 0), on_wait=press)
    assert result.outcome == "force_limited"
    assert result.reason.startswith("Fz: -9 N (90% of 10 N)")
    assert 0.001 < height() < 0.02
    assert feeling.move(at(0, 0, 0.025), mode="retreat").outcome == "done"


def test_the_hard_limit_is_a_safety_stop_that_can_be_retracted_from(feeling, force):
    with pytest.raises(SafetyStop, match="hard limit"):
        feeling.move(at(0, 0, 0), on_wait=lambda: push(force, 11.0 if height() < 0.02 else 1.0))
    assert stands_still()
    before = height()
    assert feeling.retract()
    assert height() == pytest.approx(before + CONFIG.retract, abs=1e-4)


def test_a_force_that_falls_silent_stops_the_arm_and_says_what_to_check(feeling, force):
    slow = {"speed": 0.005, "acceleration": 0.1}
    with pytest.raises(DeviceLost, match=r"force is .* old.*F/T sensor"):
        feeling.move(at(0, 0, 0), **slow, on_wait=Once(lambda: push(force, 0.0, age=3.0)))
    assert stands_still()
    assert 0.001 < height() < 0.03
    assert feeling.alive
    assert feeling.retract()


def test_a_load_that_comes_while_the_arm_rests_is_told_by_check(feeling, force):
    push(force, 0.0)
    assert feeling.move(at(0, 0, 0.029)).outcome == "done"
    feeling.check()
    push(force, 12.0)

    def alarmed() -> bool:
        try:
            feeling.check()
        except SafetyStop as error:
            return "hard limit" in str(error)
        return False

    wait_until(alarmed)


def test_a_killed_child_is_device_lost_the_watchdog_stops_the_arm_and_it_recovers(arm):
    with pytest.raises(DeviceLost, match=r"crashed \(exit code -9\)"):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: os.kill(child(), signal.SIGKILL)))
    assert not arm.alive
    with pytest.raises(DeviceLost, match="crashed"):
        arm.halt()
    assert not arm.retract()
    wait_until(lambda: "watchdog" in inject()["reason"])
    assert stands_still()
    before = height()
    assert 0.001 < before < 0.03
    assert arm.recover_and_retract()
    assert height() == pytest.approx(before + CONFIG.retract, abs=1e-4)


def test_a_hanging_child_is_ended_in_bounded_time(arm, monkeypatch):
    monkeypatch.setattr("rig.devices.arm.arm._STOP_ANSWER", 1.0)
    os.kill(child(), signal.SIGSTOP)
    with pytest.raises(DeviceLost, match="did not answer"):
        arm.halt()
    assert not arm.alive
    wait_until(lambda: "watchdog" in inject()["reason"])


def test_a_killed_controller_is_device_lost_in_bounded_time(arm, emulator):
    def kill() -> None:
        emulator.kill()
        emulator.wait()

    once = Once(kill)
    with pytest.raises(DeviceLost, match=HOST):
        arm.move(at(0, 0, 0), on_wait=lambda: once.done or once())
    assert once.done
    assert not arm.recover_and_retract(10.0)
    assert not multiprocessing.active_children()


def test_a_controller_that_falls_silent_is_device_lost_in_bounded_time(arm):
    with pytest.raises(DeviceLost, match=HOST):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: inject("freeze", seconds=5.0)))
    wait_until(lambda: not moving())


def test_dropped_connections_are_device_lost_not_a_crash_of_ours(arm):
    with pytest.raises(DeviceLost, match=HOST):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: inject("drop")))
    wait_until(lambda: not moving())
    assert arm.recover_and_retract()


@pytest.mark.parametrize(
    ("fault", "words"), [("protective_stop", "unlock"), ("emergency_stop", "release")]
)
def test_a_safety_stop_is_never_reset_from_here(arm, fault, words):
    with pytest.raises(SafetyStop, match=f"{words}.* at the pendant"):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: inject(fault)))
    place = inject()["pose"]
    for act in (lambda: arm.move(at(0, 0, 0.03), mode="retreat"), arm.halt):
        with pytest.raises(SafetyStop, match="at the pendant"):
            act()
    assert not arm.retract()
    arm.close()
    with pytest.raises(SafetyStop, match="at the pendant"):
        arm.start(20.0)
    assert not arm.recover_and_retract()
    state = inject()
    assert state["safety_status"] != 1
    assert state["uploads"] == 1
    assert_allclose(state["pose"], place, atol=1e-4)


def test_after_a_person_released_a_protective_stop_it_retracts(arm):
    with pytest.raises(SafetyStop):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: inject("protective_stop")))
    before = height()
    inject("reset_safety")
    arm.close()
    assert arm.recover_and_retract()
    assert height() == pytest.approx(before + CONFIG.retract, abs=1e-4)


def test_a_program_stopped_at_the_pendant_is_device_lost_and_recovers(arm):
    with pytest.raises(DeviceLost, match="program stopped"):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: inject("stop_program")))
    assert arm.recover_and_retract()


def test_an_arm_in_local_control_is_not_started(emulator):
    inject("remote_control", on=False)
    arm = make()
    with pytest.raises(DeviceLost, match="local control"):
        arm.start(20.0)
    assert not arm.alive
    with pytest.raises(DeviceLost, match="local control"):
        arm.halt()


def test_nobody_there_is_device_lost_with_the_address():
    arm = make()
    with pytest.raises(DeviceLost, match=rf"{HOST}:30004 \(RTDE\).*controller on"):
        arm.start(20.0)
    arm.close()


PARENT = """
import multiprocessing, sys
from tests_motion import at, make
if __name__ == "__main__":
    arm = make()
    arm.start(20.0)
    print(multiprocessing.active_children()[0].pid, flush=True)
    arm.move(at(0, 0, 0))
    print("moved", flush=True)
"""


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_dead_parent_leaves_an_arm_that_halts_retracts_and_lets_go(emulator, tmp_path, how):
    script = PARENT.replace("tests_motion", f"tests.rig.{Path(__file__).stem}")
    # The host is derived from the process id: the script must use ours.
    script = script.replace("    arm = make()", f"    arm = make(config={CONFIG!r})")
    script = script.replace("import multiprocessing, sys", "import multiprocessing")
    script = "from rig.devices.arm.settings import ArmConfig\n" + script
    (tmp_path / "parent.py").write_text(script)
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    with subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py")],
        env={**os.environ, "PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        text=True,
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        wait_until(moving)
        parent.send_signal(how)
        assert parent.wait(20.0) == -how
    wait_until(lambda: gone(pid))
    state = inject()
    assert state["reason"] == "end of program"
    # It came down for a while, and went up by the retract.
    assert 0.011 < height() < 0.03 + CONFIG.retract
    assert stands_still()
