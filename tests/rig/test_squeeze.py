"""Squeezes of a hand: bench file, plan, commands to the gripper, and that it never opens aloft."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.collecting import faults_of
from support.drivers import running
from support.hands import STEPS, begun_session, pads
from support.waiting import until

from benchmarks.fake_clock import FakeClock
from recorder.session import Session
from rig.acquire.squeeze import Squeezing
from rig.bench.bench import read_content
from rig.bench.pair import PairFile
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, DeviceLost
from rig.core.packaged import BENCHES
from rig.core.samples import HAND_TRUTH, WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.devices.gripper.robotiq import GripperStream
from rig.devices.gripper.robotiq_emulator import Fingers, Hand, RobotiqEmulator
from rig.devices.gripper.robotiq_wire import AT_POSITION, STOPPED_CLOSING, GripperCommand
from rig.devices.gripper.settings import HandConfig
from tactile.run import main

PATH = BENCHES / "pair.yaml"


ONE = {"name": "one", "width_mm": 30.0, "mass_kg": 0.1}


def content(**changes: Any) -> dict[str, Any]:
    return {**read_content(PATH), **changes}


def test_fingers_have_the_settings_of_their_sensors_and_their_own() -> None:
    fingers = {"left": {"sensor": "uskin", "device": {"rate_hz": 100.0}}}
    fingers["right"] = {"sensor": "gelsight", "device": {"kind": "v4l2", "address": "/dev/video2"}}
    bench = PairFile.of_sensors(content(fingers=fingers), PATH).bench
    assert [row.kind for row in bench.rows] == ["taxels", "camera", "gripper"]
    assert [row.config.KIND for row in bench.rows] == ["xela", "v4l2", "robotiq_2f"]
    assert bench.row("left").rate_hz == 100
    assert [finger.depth_max for finger in bench.fingers.values()] == pytest.approx(
        [1.1e-3, 1.3e-3]
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fingers": {"left": {"sensor": "nothing"}}}, "fingers.left.sensor"),
        ({"squeeze": {"steps": 9}}, "allowed: up to 2.6 mm"),
        ({"squeeze": {"turns": [[1.0, 1.0, 0.0]]}}, "allowed: unit vectors"),
        ({"arm": "ur"}, "arm"),
        ({"squeeze": {"step_mm": 0.1}}, "allowed: 0.37, one count of the gripper, or more"),
        ({"objects": [{**ONE, "width_mm": 83.0}]}, "one.width_mm: 83; allowed: above 1.85"),
        ({"objects": [{**ONE, "name": "../x"}]}, "objects.name: found"),
        ({"objects": [{**ONE, "faces": ["ball", "cylinder"]}]}, "found 'ball'"),
        ({"objects": [{**ONE, "faces": ["sphere_s", "cylinder"]}]}, "mm into the left skin"),
        ({"compliance": -1e-5}, "compliance"),
    ],
)
def test_errors_of_the_file_name_what_is_allowed(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        PairFile.of_sensors(content(**changes), PATH)


class FakeHand:
    """Streams, gripper and hands; `lose_at` is the command at which the gripper is lost."""

    def __init__(self, lose_at: int = 1000) -> None:
        self.bench, self.log, self.lose_at = pads().bench, [], lose_at
        self.commands = 0

    def __getitem__(self, name: str) -> Any:
        return SimpleNamespace(command=self.command, latest=self.latest)

    def command(self, opening: float, speed: int, force: int) -> None:
        assert (speed, force) == (0, 0)
        self.commands += 1
        self.opening = opening
        self.log.append(round(1e3 * opening, 2))

    def latest(self) -> dict[str, Any]:
        return {"commanded": self.opening, "object": AT_POSITION}

    def check(self) -> None:
        if self.commands >= self.lose_at:
            raise DeviceLost("gripper: no answer")

    def hands(self, what: str, **values: Any) -> None:
        self.log.append(what if what != "carry" else values["lifted"])


class Made(Squeezing):
    """Squeezing of fingers whose signals are made up: level of contact, and motion."""

    level, motion = 1.0, 0.0

    def _parts(self, name: str, start_ns: int, end_ns: int) -> tuple[np.ndarray, np.ndarray]:
        first = np.full((16, 3), 100.0 * self.level * bool(self._rest.get(name)))
        return first, first + self.motion

    def _wait(self, seconds: float) -> None:
        self._check()


@contextlib.contextmanager
def squeezing(path: Path, hand: FakeHand, kind: type[Made] = Made) -> Iterator[Made]:
    writer, interrupt = begun_session(path), SimpleNamespace(check=lambda: None)
    made = kind(pads().bench, hand, writer, hand.hands, interrupt)  # type: ignore[arg-type]
    try:
        yield made
    finally:
        made.close()
        writer.close()


def test_the_hand_opens_only_once_somebody_carries_the_object(tmp_path: Path) -> None:
    hand = FakeHand()
    with squeezing(tmp_path / "s.zarr", hand) as made:
        made.run(STEPS[:3])
        assert not made.aloft
    opened, first, second, released = (entry for entry in hand.log if isinstance(entry, float))
    assert opened == released > first > second
    begun, held = [False, opened, "turn", "place"], [first, second, True]
    assert hand.log == [*begun, *held, False, released, "place"]
    assert made.done == 3


def test_a_lost_gripper_aloft_stays_closed(tmp_path: Path) -> None:
    hand = FakeHand(lose_at=3)
    with squeezing(tmp_path / "s.zarr", hand) as made:
        with pytest.raises(DeviceLost):
            made.run(STEPS[:6])
        assert made.closed
    sent = [entry for entry in hand.log if isinstance(entry, float)]
    assert sent == sorted(sent, reverse=True)
    assert False not in hand.log[1:]


@pytest.mark.parametrize(("level", "motion"), [(0.0, 0.0), (1.0, 50.0)])
def test_a_hold_that_moves_or_touches_nothing_is_kept_and_marked(
    level: float, motion: float, tmp_path: Path
) -> None:
    hand = FakeHand()
    with squeezing(tmp_path / "s.zarr", hand) as made:
        made.run(STEPS[:1])
        made.level, made.motion = level, motion
        made.run(STEPS[1:3])
        assert made.unsteady == 2
    assert Session(tmp_path / "s.zarr", unsealed=True).segments["outcome"].tolist() == [0, 4, 4, 0]


@pytest.mark.parametrize(
    ("turn", "why"), [(1.0, ""), (-1.0, "left touches"), (0.0, "left touches")]
)
def test_only_a_finger_above_the_object_may_hardly_touch(
    turn: float, why: str, tmp_path: Path
) -> None:
    class Left(Made):
        def _parts(self, name: str, *times: int) -> tuple[np.ndarray, np.ndarray]:
            self.level = float(name == "right")
            return super()._parts(name, *times)

    step = STEPS[1]._replace(turn=(turn, 0.0, 1 - abs(turn)), lifted=True)
    with squeezing(tmp_path / "s.zarr", FakeHand(), Left) as made:
        made.run(STEPS[:1])
        # The made-up gripper has no samples.
        assert made._unsteady(0, 1, step).startswith(why or "the gripper")


def test_fingers_of_a_hand_stop_at_the_force_of_the_motor(tmp_path: Path) -> None:
    device, clock = HandConfig(port=str(tmp_path / "tty")), FakeClock()
    hand = SharedLatest.create(tmp_path / "hand", HAND_TRUTH)
    world = SharedLatest.create(tmp_path / "left", WORLD_STATE)
    fingers = Fingers(clock, hand=Hand(device, tmp_path / "hand", tmp_path / "left"))
    state = np.zeros(1, WORLD_STATE)[0]

    def pressed(force: float, seconds: float) -> int:
        state["wrench"][2] = -force
        world.write(state)
        for _ in range(round(seconds / 0.01)):
            clock.sleep_until(clock.now_ns() + 10_000_000)
            fingers.advance()
        return fingers.status().object

    fingers.obey(GripperCommand(go=True, position=200, speed=0, force=0))
    pressed(0.0, 0.5)
    told = hand.read()
    assert told is not None
    # 60 counts of 0.37 mm a second are some 22 mm/s; the fingers began at count 3.
    assert told["opening"] == pytest.approx(device.opening(3 + 0.5 * 60), abs=1e-3)
    pressed(19.0, 0.2)
    before = fingers.status().position
    assert pressed(20.5, 0.5) == STOPPED_CLOSING
    assert fingers.status().position - before <= 1
    fingers.obey(GripperCommand(go=True, position=200, speed=0, force=255))
    assert pressed(20.5, 3.0) == AT_POSITION
    assert fingers.status().position == 200


def test_the_stream_of_a_gripper_follows_its_commands(tmp_path: Path) -> None:
    device = HandConfig(port=str(tmp_path / "tty"), rate_hz=50.0)
    SharedLatest.create(tmp_path / "hand", HAND_TRUTH).close()
    clock = SystemClock()
    fingers = Fingers(clock, hand=Hand(device, tmp_path / "hand", None))
    with running(RobotiqEmulator(fingers, tmp_path / "tty", clock, delay=0.005)):
        driver = GripperStream(device, clock)
        driver.open(20.0)
        try:
            driver.command(0.0801, 255, 0)
            seen: list[dict[str, Any]] = []
            due = device.opening(device.position(0.0801))
            until(
                lambda: bool(seen.extend(driver.read(0.1)) or (seen and seen[-1]["value"] == due))
            )
        finally:
            driver.close()
    assert seen[-1]["commanded"] == due
    assert abs(due - 0.0801) <= device.per_count / 2
    assert all(np.diff([row["t_ns"] for row in seen]) >= 5_000_000)
    counts = np.array([row["value"] for row in seen]) / device.per_count
    np.testing.assert_allclose(counts, counts.round(), atol=1e-6)


@pytest.mark.slow
@pytest.mark.serial
def test_a_mock_hand_is_collected_replayed_and_balances(tmp_path: Path) -> None:
    out, again = tmp_path / "s.zarr", tmp_path / "again.zarr"
    truth = ["--truth", str(tmp_path / "truth")]
    assert main(["collect", "--bench", "pair", "--targets", "12", "--out", str(out), *truth]) == 0
    assert faults_of(out) == []
    session = Session(out)
    assert (np.asarray(session.segments["outcome"]) == 0).all()
    left, right = (
        np.fromfile(tmp_path / "truth" / name, WORLD_STATE) for name in ("left", "right")
    )
    targets, segments = session.targets, session.segments
    for row in np.flatnonzero(segments["phase"] == 0):
        target = segments["target"][row]
        at = np.searchsorted(left["t_ns"], segments["end_ns"][row]) - 1
        load = 9.80665 * targets["mass"][target] * targets["turn"][target][0]
        found = left["wrench"][at, 2] - right["wrench"][at, 2]
        assert found == pytest.approx(load * targets["lifted"][target], abs=2e-3)
    assert main(["replay", "--session", str(out), "--out", str(again)]) == 0
