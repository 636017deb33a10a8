"""A stage with GRBL on a serial port moves like an arm: to its goal, and never on by itself."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder import OUTCOMES, Session
from rig.acquire.campaign import run_rig
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.core.guard import GuardLimits, judge_safety
from rig.core.packaged import BENCHES
from rig.devices.arm import gcode_emulator
from rig.devices.arm.arm import Arm
from rig.devices.arm.gcode import StageClient, StageDriver
from rig.devices.arm.gcode_emulator import GcodeEmulatorConfig, GrblEmulator
from rig.devices.arm.reader import COLUMNS
from rig.devices.arm.settings import GcodeConfig

CLOCK = SystemClock()
START = np.array([0.01, 0.02, 0.1])


def off(x: float, y: float, z: float) -> np.ndarray:
    return START + np.array([x, y, z])


class Bench:
    """An emulated stage, the process that owns its port, and the one that moves it."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.config = GcodeConfig(port=str(folder / "stage"), watchdog_hz=2.0)
        pose = (*START.tolist(), *self.config.rotation)
        self.emulator = GrblEmulator(
            GcodeEmulatorConfig(device=self.config, pose=pose, **settings), CLOCK
        )
        self.emulator.start()
        self.driver = StageDriver(self.config, CLOCK)
        self.client = StageClient(self.config, CLOCK)
        self.samples: list[dict[str, Any]] = []

    def open(self) -> None:
        self.driver.open(5.0)
        self.client.open(1.0)

    def close(self) -> None:
        self.client.close()
        self.driver.close()
        self.driver.close()
        self.emulator.close()

    def move(self, goal: np.ndarray, speed: float = 0.02) -> None:
        self.follow(lambda: bool(self.samples))
        before, _ = self.client.operation()
        assert self.client.start_move([*goal.tolist(), *self.config.rotation], speed, 0.1)
        self.follow(lambda: self.client.operation()[0] != before)

    def follow(self, until: Callable[[], bool], kick: bool = True) -> None:
        """Receive samples until something holds; a hang is ended by the time limit of the test."""
        while not until():
            self.samples += self.client.receive(0.1)
            assert not kick or self.client.kick()

    def ended(self) -> bool:
        return not self.client.operation()[1]

    def at_rest(self) -> np.ndarray:
        """Wait until the stage has stood still for 0.1 s; return its place."""
        while True:
            place = self.emulator.place
            CLOCK.sleep_until(CLOCK.now_ns() + 100_000_000)
            if np.array_equal(place, self.emulator.place):
                return place


def read_until_lost(driver: StageDriver) -> None:
    for _ in range(100):
        driver.read(0.1)


@pytest.fixture
def unopened(tmp_path: Path) -> Iterator[Bench]:
    with closing(Bench(tmp_path)) as bench:
        yield bench


@pytest.fixture
def bench(unopened: Bench) -> Bench:
    unopened.open()
    return unopened


def test_poses_have_the_columns_of_an_arm(bench: Bench) -> None:
    while not bench.samples:
        bench.samples += bench.driver.read(1.0)
    sample = bench.samples[0]
    assert set(sample) == {*COLUMNS, "t_ns"}
    np.testing.assert_allclose(sample["value"], [*START, np.pi, 0, 0], atol=1e-6)
    assert judge_safety(sample["safety_status"]) is None
    assert bench.driver.describe()["controller_version"] == "1.1h.20190825"


def test_a_stage_left_in_a_hold_is_open_once_it_is_clear_and_its_version_known(
    unopened: Bench,
) -> None:
    unopened.emulator.state = "Hold"
    unopened.driver.open(5.0)
    assert unopened.driver.describe()["controller_version"] == "1.1h.20190825"


def test_moves_end_at_their_goals_in_pieces_that_are_sent_as_the_stage_goes(bench: Bench) -> None:
    for goal in (off(0.004, 0, -0.003), off(0.004, 0.002, 0)):
        bench.move(goal)
        assert not bench.ended()
        bench.follow(bench.ended)
        np.testing.assert_allclose(bench.emulator.place, goal, atol=2e-6)
        np.testing.assert_allclose(bench.samples[-1]["value"][:3], goal, atol=2e-6)
    moves = [line for line in bench.emulator.received if line.startswith("G1")]
    assert len(moves) >= 4
    assert moves[0].startswith("G1 X11.6000 Y20.0000 Z98.8000 F1200")


def test_a_stop_leaves_the_stage_ready_where_it_is(bench: Bench) -> None:
    bench.move(off(0.05, 0, 0))
    bench.follow(lambda: bench.emulator.place[0] > START[0] + 0.002)
    bench.client.start_stop(1.0)
    before, _ = bench.client.operation()
    bench.follow(lambda: bench.client.operation()[0] != before and bench.ended())
    place = bench.at_rest()
    assert place[0] < START[0] + 0.045
    assert bench.emulator.state == "Idle"
    bench.move(START)
    bench.follow(bench.ended)
    np.testing.assert_allclose(bench.emulator.place, START, atol=2e-6)


@pytest.mark.parametrize("end", ["client gone", "client silent", "driver closed"])
def test_a_stage_that_nobody_follows_stops_by_itself(bench: Bench, end: str) -> None:
    bench.move(off(0.1, 0, 0))
    bench.follow(lambda: bench.emulator.place[0] > START[0] + 0.002)
    if end == "client gone":
        bench.client.close()
    elif end == "driver closed":
        bench.driver.close()
        with pytest.raises(DeviceLost, match="owns its port is gone"):
            bench.follow(lambda: False, kick=False)
    else:
        bench.follow(bench.ended, kick=False)
    assert bench.at_rest()[0] < START[0] + 0.09
    bench.client.close()
    bench.driver.close()
    bench.samples = []
    bench.open()
    bench.move(START)
    bench.follow(bench.ended)
    np.testing.assert_allclose(bench.emulator.place, START, atol=2e-6)


def test_an_alarm_is_a_safety_stop(bench: Bench) -> None:
    bench.move(off(0.05, 0, 0))
    bench.emulator.apply("alarm")
    bench.follow(lambda: bench.samples[-1]["safety_status"] != 1)
    violation = judge_safety(bench.samples[-1]["safety_status"])
    assert violation is not None
    assert violation.kind == "protective_stop"


def test_only_the_tip_s_own_orientation_is_reached(bench: Bench) -> None:
    place = START.tolist()
    assert bench.client.reaches([*place, np.pi, 0, 0])
    assert bench.client.reaches([*place, -np.pi, 0, 0])
    assert not bench.client.reaches([*place, np.pi - 0.1, 0, 0])


def test_a_stage_that_is_not_ready_is_named(tmp_path: Path) -> None:
    with pytest.raises(DeviceLost, match="nothing records its poses"):
        StageClient(GcodeConfig(port=str(tmp_path / "none")), CLOCK).open(0.1)
    with pytest.raises(DeviceLost, match="group dialout"):
        StageDriver(GcodeConfig(port=str(tmp_path / "none")), CLOCK).open(0.1)
    with closing(Bench(tmp_path, homed=False)) as bench:
        with pytest.raises(DeviceLost, match=r"not homed.*\$H"):
            bench.driver.open(5.0)
        bench.emulator.apply("unlock")
        bench.emulator.apply("freeze", seconds=60)
        with pytest.raises(DeviceLost, match="no position from a board with GRBL within"):
            bench.driver.open(0.3)
        bench.emulator.apply("clear")
        bench.open()
        with pytest.raises(DeviceLost, match="moved by another collection"):
            bench.driver._listening()
        bench.emulator.apply("freeze", seconds=60)
        with pytest.raises(DeviceLost, match="no position for 1 s"):
            read_until_lost(bench.driver)


def test_a_board_without_a_version_or_in_motion_is_refused(
    unopened: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gcode_emulator, "VERSION", b"ok\r\n")
    with pytest.raises(
        DeviceLost, match=r"no version \(\[VER:\.\.\.\] in answer to \$I\) within 1 s"
    ):
        unopened.driver.open(1.0)
    unopened.emulator.state = "Check"
    with pytest.raises(DeviceLost, match=r"still in state Check after 1 s"):
        unopened.driver.open(1.0)


def test_positions_of_the_work_are_refused(bench: Bench) -> None:
    with pytest.raises(ConfigError, match=r"WPos; allowed: MPos \(send \$10=1"):
        bench.driver._take("<Idle|WPos:0.000,0.000,0.000|FS:0,0>")


@pytest.mark.slow
@pytest.mark.timeout(60)
def test_the_arm_of_a_collection_moves_halts_and_retracts_it(bench: Bench) -> None:
    bench.client.close()
    frame = (*(START - (0, 0, 0.03)).tolist(), 0.0, 0.0, 0.0)
    limits = GuardLimits(
        force_rating=(10.0,) * 6,
        soft_fraction=0.85,
        hard_fraction=1.0,
        horizon=0.02,
        stale_force=2.0,
        stale_pose=2.0,
        box=((-0.01, -0.01, -0.001), (0.01, 0.01, 0.06)),
    )
    arm = Arm(bench.config, frame, limits, gauges={}, pose_path=None)
    arm.start(10.0)
    try:
        goal = START - (0.0, 0.005, 0.01)
        done = arm.move([*goal, np.pi, 0, 0], speed=0.02)
        assert done.outcome == "done"
        np.testing.assert_allclose(bench.emulator.place, goal, atol=2e-6)
        turned = arm.move([*START, np.pi - 0.2, 0, 0], speed=0.02)
        assert (turned.outcome, "out of reach" in turned.reason) == ("stopped", True)
        far = threading.Timer(0.5, arm.halt)
        far.start()
        halted = arm.move([*off(0, 0.01, 0.02), np.pi, 0, 0], speed=0.002)
        far.join()
        assert halted.outcome == "stopped"
        low = bench.at_rest()[2]
        assert arm.retract()
        assert bench.emulator.place[2] > low + 0.015
    finally:
        arm.close()


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.timeout(180)
def test_a_mock_bench_with_a_stage_collects(tmp_path: Path) -> None:
    file, out = tmp_path / "stage.yaml", tmp_path / "x.zarr"
    arm = "{kind: gcode, port: runfolder/stage, watchdog_hz: 2.0}"
    file.write_text(f"extends: {BENCHES / 'gelsight.yaml'}\narm: {arm}\n")
    assert run_rig(["collect", "--bench", str(file), "--targets", "2", "--out", str(out)]) == 0
    session = Session(out)
    outcomes = np.asarray(session.segments["outcome"])
    assert set(outcomes.tolist()) == {OUTCOMES.index("complete")}
    force = np.asarray(session.streams["force"].array("value"))
    assert force[:, 2].min() < -0.5
