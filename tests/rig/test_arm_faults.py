"""Arms that crash, hang, fall silent, stop or lose their parent, each with its own emulator."""

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support.arms import (
    CONFIG,
    HOST,
    ROOT,
    TCP,
    Once,
    at,
    emulated,
    height,
    inject,
    make,
    moving,
    stands_still,
    started,
)
from support.waiting import until

from benchmarks.fake_clock import FakeClock
from rig.core.clock import SECOND_NS
from rig.core.errors import DeviceLost, SafetyStop
from rig.devices.arm.arm import Arm
from rig.devices.arm.messages import Move
from rig.devices.arm.mover import Mover
from tests.support.few import few

pytest.importorskip("rtde_control", reason="ur-rtde is not installed: pip install -e '.[rig]'")

PLAYING = 2


def child() -> int:
    (process,) = multiprocessing.active_children()
    assert process.pid is not None
    return process.pid


@pytest.fixture
def emulator() -> Iterator[subprocess.Popen[str]]:
    with emulated() as process:
        yield process


@pytest.fixture
def arm(emulator: subprocess.Popen[str]) -> Iterator[Arm]:
    with started() as arm:
        yield arm


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


def test_a_killed_child_is_device_lost_the_watchdog_stops_the_arm_and_it_recovers(arm):
    with pytest.raises(DeviceLost, match=r"crashed \(exit code -9\)"):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: os.kill(child(), signal.SIGKILL)))
    assert not arm.alive
    with pytest.raises(DeviceLost, match="crashed"):
        arm.halt()
    assert not arm.retract()
    until(lambda: "watchdog" in inject()["reason"])
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
    until(lambda: "watchdog" in inject()["reason"])


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


@pytest.mark.parametrize(
    ("fault", "values", "words", "recovers"),
    [
        ("freeze", {"seconds": 5.0}, HOST, False),
        ("drop", {}, HOST, True),
        ("stop_program", {}, "program stopped", True),
    ],
    ids=["it falls silent", "its connections drop", "its program is stopped at the pendant"],
)
def test_a_controller_lost_in_mid_move_is_device_lost_in_bounded_time(
    arm, fault, values, words, recovers
):
    with pytest.raises(DeviceLost, match=words):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: inject(fault, **values)))
    until(lambda: not moving())
    if recovers:
        assert arm.recover_and_retract()


@pytest.mark.parametrize(
    ("fault", "words"),
    few([pytest.param("protective_stop", "unlock"), pytest.param("emergency_stop", "release")], 1),
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


def test_a_program_that_ended_between_two_commands_is_named(arm):
    inject("stop_program")
    until(lambda: not arm.alive)
    with pytest.raises(DeviceLost, match="program stopped"):
        arm.move(at(0, 0, 0))
    assert arm.recover_and_retract()


@pytest.mark.parametrize(("runs", "words"), [(False, "program stopped"), (True, "out of reach")])
def test_a_move_that_an_ended_program_refused_is_not_called_out_of_reach(runs, words):
    control = SimpleNamespace(connected=lambda: True, kick=lambda: runs, reaches=lambda pose: False)
    watch = SimpleNamespace(
        look=lambda mode: None,
        look_again=lambda seconds: None,
        require_fresh=lambda: None,
        fresh=lambda: True,
        pose=np.zeros(6),
        speed_fraction=1.0,
    )
    mover = Mover(SimpleNamespace(config=CONFIG), control, watch, FakeClock(), lambda: False)
    try:
        found = mover.move(Move(1, (0.0,) * 6, 0.1, 0.1, "retreat"), lambda seconds: None).reason
    except DeviceLost as error:
        found = str(error)
    assert words in found


def test_a_slow_process_kicks_the_watchdog_in_time():
    clock, kicks = FakeClock(), [0]
    control = SimpleNamespace(connected=lambda: True, kick=lambda: not kicks.append(clock.now_ns()))
    watch = SimpleNamespace(look=lambda mode: clock.advance(0.03), speed_fraction=1.0)
    watch.fresh = control.connected
    mover = Mover(SimpleNamespace(config=CONFIG), control, watch, clock, lambda: False)
    for _ in range(50):
        mover.step("travel")
    assert np.diff(kicks).max() * CONFIG.watchdog_hz < SECOND_NS / 2


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
import multiprocessing
from rig.devices.arm.settings import ArmConfig
from support.arms import at, make
if __name__ == "__main__":
    arm = make(config=CONFIG)
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
    # The host is derived from the process id: the script must use this process's.
    (tmp_path / "parent.py").write_text(PARENT.replace("CONFIG", repr(CONFIG)))
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    with subprocess.Popen(
        [sys.executable, str(tmp_path / "parent.py")],
        env={**os.environ, "PYTHONPATH": paths},
        stdout=subprocess.PIPE,
        text=True,
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        until(moving)
        parent.send_signal(how)
        assert parent.wait(240) == -how
    until(lambda: gone(pid))
    assert inject()["reason"] == "end of program"
    # It moved down for a while, and up by the retract distance.
    assert 0.011 < height() < 0.03 + CONFIG.retract
    assert stands_still()
