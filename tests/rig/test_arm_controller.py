import json

import numpy as np
import pytest
from numpy.testing import assert_allclose
from support.arms import MOVE_L, SCRIPT, START, STOP_L, TCP, Client

from rig.core import emulation
from rig.core.clock import SystemClock
from rig.core.geometry import compose, rotation_between
from rig.devices.arm.emulated_arm import CYCLE, flange_pose
from rig.devices.arm.emulated_controller import PLAYING, STOPPED, Controller, dashboard_answer
from rig.devices.arm.emulator import ArmEmulator

SET_TCP, WATCHDOG, IN_LIMITS = 29, 35, 36


@pytest.fixture
def controller() -> Controller:
    return Controller(START, TCP)


@pytest.fixture
def client(controller) -> Client:
    return Client(controller)


def above(height: float, rotation=(0.0, 0.0, 0.0)) -> np.ndarray:
    return compose(START, [0.0, 0.0, -height, *rotation])


def test_the_program_runs_only_after_the_upload(controller):
    assert controller.runtime_state == STOPPED
    client = Client(controller)
    assert controller.runtime_state == PLAYING
    assert client.state == 1


@pytest.mark.parametrize(("slider", "shortest", "longest"), [(1.0, 0.28, 0.32), (0.5, 0.56, 0.64)])
def test_a_synchronous_move_is_done_when_the_arm_is_there_and_the_slider_slows_it(
    client, slider, shortest, longest
):
    goal = above(0.01, (0.02, 0.0, 0.05))
    client.controller.robot.slider = slider
    took = client.command(MOVE_L, [*goal, 0.05, 0.5])
    # 10 mm at 50 mm/s, with ramps of 0.1 s.
    assert shortest <= took * CYCLE <= longest
    assert_allclose(client.controller.robot.pose, goal)


def test_a_move_follows_a_straight_line_within_its_speed(client):
    goal, places, speeds = above(0.02), [], []
    client.write(MOVE_L, [*goal, 0.05, 0.5], 1)
    while not places or not np.allclose(places[-1], goal[:3], atol=1e-9):
        client.run(1)
        places.append(client.controller.robot.pose[:3].copy())
        speeds.append(np.linalg.norm(client.controller.robot.speed[:3]))
    way = (goal - START)[:3]
    fraction = (np.array(places) - START[:3]) @ way / (way @ way)
    assert_allclose(np.array(places), START[:3] + fraction[:, None] * way, atol=1e-12)
    assert (np.diff(fraction) >= 0).all()
    assert max(speeds) == pytest.approx(0.05, rel=1e-6)


def test_an_asynchronous_move_is_told_in_the_operation_word(client):
    operation, writes, running = client.word
    assert not running
    assert client.command(MOVE_L, [*above(0.01), 0.05, 0.5], 1) <= 2
    assert client.word == (operation + 1, writes + 1, True)
    client.run(400)
    assert client.word == (operation + 1, writes + 2, False)


def test_an_asynchronous_stop_ends_the_move_and_is_an_operation_of_its_own(client):
    client.command(MOVE_L, [*above(0.05), 0.05, 0.5], 1)
    client.run(200)
    operation = client.word[0]
    client.command(STOP_L, [2.0], 1)
    client.run(100)
    assert client.word[0] == operation + 1
    assert not client.word[2]
    place = client.controller.robot.pose.copy()
    client.run(100)
    assert_allclose(client.controller.robot.pose, place)
    assert place[2] < above(0.05)[2] - 0.01


def test_the_watchdog_stops_program_and_arm(client):
    client.command(WATCHDOG, [10.0])
    client.command(MOVE_L, [*above(0.05), 0.05, 0.5], 1)
    for _ in range(20):
        client.run(40)
        client.write(0)
    assert client.controller.runtime_state == PLAYING
    client.run(52)
    assert client.controller.runtime_state == STOPPED
    assert "watchdog" in client.controller.reason
    client.run(20)
    assert not client.controller.robot.speed.any()


def test_a_new_program_has_no_watchdog(client):
    client.command(WATCHDOG, [10.0])
    client.run(100)
    Client(client.controller).run(500)
    assert client.controller.runtime_state == PLAYING


def test_setting_the_tcp_leaves_the_flange(client):
    client.command(SET_TCP, [0, 0, 0.15, 0, 0, 0])
    assert_allclose(client.controller.robot.pose, compose(START, [0, 0, 0.05, 0, 0, 0]), atol=1e-12)


def test_poses_beyond_reach_are_no_start_and_told_from_those_within(client):
    beyond = [2.0, 0, 0, 0, 0, 0]
    for pose, result in ((above(0.1), 1), (beyond, 0)):
        client.command(IN_LIMITS, pose)
        assert client.result == result
    with pytest.raises(ValueError, match="out of reach"):
        Controller(np.array(beyond), TCP)


def test_joint_angles_follow_the_pose(client):
    client.command(MOVE_L, [*above(0.05, (0.1, 0.0, 0.2)), 0.1, 1.0])
    robot = client.controller.robot
    pose = compose(flange_pose(robot.joints), robot.tcp)
    assert_allclose(pose[:3], robot.pose[:3], atol=1e-8)
    assert np.linalg.norm(rotation_between(pose, robot.pose)) < 1e-8


def test_contact_force_above_the_limit_is_a_protective_stop_that_stays(client):
    controller = client.controller
    client.command(MOVE_L, [*above(0.05), 0.05, 0.5], 1)
    client.run(100)
    controller.wrench = np.array([0, 0, -151.0, 0, 0, 0])
    client.run(1)
    controller.wrench = np.zeros(6)
    client.run(50)
    assert controller.source("safety_status_bits")() == 0x404
    assert controller.runtime_state == STOPPED
    assert not controller.robot.speed.any()
    controller.start_program(SCRIPT)
    assert controller.runtime_state == STOPPED
    controller.reset_safety()
    controller.start_program(SCRIPT)
    assert controller.runtime_state == PLAYING


def test_the_dashboard_says_what_ur_rtde_compares_word_for_word(client):
    def answer(line):
        return dashboard_answer(client.controller, line)

    assert answer("get serial number").isdigit()
    assert answer("is in remote control") == "true"
    assert answer("running") == "Program running: true"
    assert answer("stop") == "Stopped"
    assert answer("running") == "Program running: false"
    client.controller.protective_stop("test")
    assert answer("safetystatus") == "Safetystatus: PROTECTIVE_STOP"
    assert answer("unlock protective stop") == "Protective stop releasing"
    assert answer("safetystatus") == "Safetystatus: NORMAL"
    assert "could not understand" in answer("sing")
    # An emergency stop takes the power.
    client.controller.emergency_stop()
    assert answer("robotmode") == "Robotmode: POWER_OFF"
    assert client.controller.source("safety_status_bits")() & 0xE0


@pytest.mark.parametrize(
    "line", ["", "{", "[]", '{"fault": "melt"}', '{"fault": "slider"}', '{"seconds": 1}']
)
def test_the_fault_port_survives_nonsense(controller, line):
    emulator = ArmEmulator("127.0.0.1", controller, SystemClock())
    reply = json.loads(emulation.answer(emulator.apply, line))
    assert reply["ok"] is False
    assert reply["error"]
