"""The real ur_rtde in its supervised child, moving the emulator; all tests share one arm."""

import signal
import threading
from collections.abc import Iterator

import pytest
from numpy.testing import assert_allclose
from support.arms import (
    CLOCK,
    HOST,
    START,
    Once,
    at,
    back_at_start,
    emulated,
    height,
    inject,
    stands_still,
    started,
)

from rig.core.errors import SafetyStop
from rig.core.geometry import compose
from rig.devices.arm.arm import Arm
from rig.devices.arm.emulated_arm import CYCLE
from rig.devices.arm.reader import RtdePoseDriver
from rig.devices.arm.settings import ArmConfig

pytest.importorskip("rtde_control", reason="no ur-rtde: pip install 'tactile-rig[rig]'")


@pytest.fixture(scope="module")
def shared() -> Iterator[Arm]:
    with emulated(), started() as arm:
        yield arm


@pytest.fixture
def arm(shared: Arm) -> Arm:
    return back_at_start(shared)


def test_a_sequence_of_moves_reaches_every_pose_while_no_pose_is_missed(arm):
    driver = RtdePoseDriver(ArmConfig(host=HOST, rate_hz=500.0), CLOCK)
    driver.open(60.0)
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


def test_halt_stops_a_move_that_was_interrupted(arm):
    with pytest.raises(KeyboardInterrupt):
        arm.move(at(0, 0, 0), on_wait=Once(lambda: signal.raise_signal(signal.SIGINT)))
    arm.halt()
    assert stands_still()
    assert 0.001 < height() < 0.03
    assert arm.move(at(0, 0, 0.03), mode="travel").outcome == "done"


def test_halt_from_another_thread_ends_the_move_as_stopped(arm):
    thread = threading.Thread(target=arm.halt)
    result = arm.move(at(0, 0, 0), on_wait=Once(thread.start))
    thread.join()
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


@pytest.mark.parametrize("fraction", [0.2, 0.0])
def test_a_slow_slider_is_named_and_waited_for(arm, fraction, caplog):
    inject("slider", fraction=fraction)

    def raised() -> None:
        if not fraction and "at 0%: nothing moves" in caplog.text:
            inject("slider", fraction=1.0)

    assert arm.move(at(0, 0, 0.02), mode="travel", on_wait=raised).outcome == "done"
    assert f"the speed slider is at {fraction:.0%}" in caplog.text


@pytest.mark.slow
def test_a_slider_turned_down_in_mid_move_ends_it_in_bounded_time(arm):
    result = arm.move(
        at(0, 0, 0.025), mode="travel", on_wait=Once(lambda: inject("slider", fraction=0.001))
    )
    assert result.outcome == "stopped"
    assert "slider" in result.reason
