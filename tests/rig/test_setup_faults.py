"""Each fault of a bench's set-up is named by `tactile setup` or `tactile doctor`, with its cure."""

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from rig.acquire import doctor
from rig.acquire import setup_checks as checks
from rig.acquire.doctor import Finding
from rig.bench.bench import Bench, BenchFile, bench_from
from rig.core import emulation
from rig.core.clock import SystemClock
from rig.core.emulation import FaultPort
from rig.core.errors import DeviceLost
from rig.core.geometry import compose
from rig.core.mock_names import PORTS
from rig.core.packaged import BENCHES
from rig.devices.arm.emulated_controller import Controller
from rig.devices.arm.emulator import ArmEmulator
from rig.devices.camera.mjpeg_emulator import through_lens
from rig.devices.camera.settings import V4l2Config
from rig.devices.gripper.robotiq_emulator import RobotiqEmulatorConfig
from rig.devices.gripper.robotiq_emulator import emulate as emulate_gripper
from rig.devices.gripper.settings import RobotiqConfig
from rig.mock.world import LadderWorld
from rig.mock.world.host import WorldHost
from rig.mock.world.picture import MarkerPicture
from rig.mock.world.sensors import markers_of

HOST, NOBODY = f"127.44.{1 + os.getpid() % 250}.9", "127.0.0.239"
CLOCK = SystemClock()
MASS = 0.1


@dataclass
class Site:
    """A bench with an emulated arm, sensor and camera."""

    bench: Bench
    folder: Path
    monkeypatch: pytest.MonkeyPatch

    def changed(self, **sections: Any) -> Bench:
        parts = {key: replace(getattr(self.bench, key), **new) for key, new in sections.items()}
        return replace(self.bench, **parts)

    def weighed(self, matrix: Any, mass: float = MASS, laid: float = MASS) -> Finding:
        """Lay a weight on the sensor, under a gauge that is mounted by a matrix."""
        world = self.world()
        world.apply("mount", matrix=matrix)
        rest = force_of(world)
        world.apply("hand", force=[0, 0, -9.81 * laid])
        return checks.weight(self.bench.row("force"), force_of(world) - rest, mass)

    def pushed(self, matrix: Any) -> Finding:
        """Push a finger over the sensor, under a gauge that is mounted by a matrix."""
        world = self.world()
        world.apply("mount", matrix=matrix)
        ways = []
        for x, y in ((3e-4, 0), (0, 3e-4)):
            rest = force_of(world)
            force_of(world, (0, 0, -3e-4))
            ways.append((force_of(world, (x, y, -3e-4)) - rest)[:2])
        return checks.axes(self.bench.row("force"), *ways, 0.0, 1.0)

    def world(self) -> WorldHost:
        world = LadderWorld(self.bench.world, "cylinder", (0.0,) * 6)
        return WorldHost(world, None, None, None)  # type: ignore[arg-type]

    def filmed(self, gain: float, blur: float, config: Any = None) -> list[Finding]:
        """Take a picture of the sensor through a lens."""
        spec = self.bench.world
        markers = markers_of(spec)
        rims = markers.outlines(np.zeros((len(markers.points), 3)))
        picture = MarkerPicture(background=spec.background, ink=spec.ink, grey_noise=1.0)
        image = picture.image(rims)
        jpeg = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))[1].tobytes()
        row = replace(self.bench, camera=config or self.bench.camera).row("camera")
        return list(checks.camera(row, through_lens(jpeg, gain, blur), self.folder))

    def measured(self, name: str, *lost: str, **found: Any) -> Finding:
        """Examine a stream whose process measured this, or lost its device."""
        description = {"automatic": found.pop("automatic", [])}

        def check() -> None:
            if lost:
                raise DeviceLost(*lost)

        handle = SimpleNamespace(
            start_measuring=lambda _: None,
            measured=lambda _: found,
            check=check,
            latest=lambda: found.get("latest"),
        )
        return doctor._stream(self.bench, self.bench.row(name), handle, description)  # type: ignore[arg-type]


def force_of(world: WorldHost, tip: tuple[float, float, float] = (0, 0, 0.03)) -> np.ndarray:
    """Return the force that a gauge shows with the tip at a place of the contact frame."""
    return np.array(world._state(0, np.array([*tip, 0, 0, 0]))["wrench"][:3])


@pytest.fixture(scope="module")
def arm() -> Iterator[Bench]:
    bench = BenchFile.read(BENCHES / "gelsight.yaml").at(HOST, Path("run")).bench
    pose = compose(bench.contact_frame, (0, 0, 0.03, *bench.tool_rotation))
    controller = Controller(np.array(pose), np.array(bench.arm.tcp))
    controller.payload = bench.arm.payload
    emulator = ArmEmulator(HOST, controller, CLOCK)
    emulator.start()
    port = FaultPort(HOST, PORTS["arm"], emulator.apply)
    yield bench
    port.close()
    emulator.close()


def inject_arm(fault: str, **values: Any) -> None:
    emulation.inject(HOST, PORTS["arm"], fault, **values)


@pytest.fixture
def site(arm: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    yield Site(arm, tmp_path, monkeypatch)
    inject_arm("reset_safety")
    inject_arm("remote_control", on=True)
    inject_arm("version", parts=[5, 12, 4, 0])
    inject_arm("tool", mass=arm.arm.payload)


def arm_after(fault: str, **values: Any) -> Callable[[Site], Iterable[Finding]]:
    def found(site: Site) -> Iterable[Finding]:
        inject_arm(fault, **values)
        return checks.arm(HOST, 60.0)

    return found


def tool(site: Site, bench: Bench | None = None, length: float = 0.1) -> Iterable[Finding]:
    return checks.tool(bench or site.bench, CLOCK, length)


def heavy(site: Site) -> Iterable[Finding]:
    inject_arm("tool", mass=1.7)
    return tool(site)


def elsewhere(site: Site) -> Iterable[Finding]:
    frame = (*np.add(site.bench.contact_frame[:3], (0.02, 0, 0)), *site.bench.contact_frame[3:])
    touching = compose(site.bench.contact_frame, (0, 0, 0, *site.bench.tool_rotation))
    return [checks.contact(replace(site.bench, contact_frame=frame), touching)]


def full_disk(site: Site) -> Iterable[Finding]:
    usage = shutil.disk_usage(site.folder)._replace(free=10**8)
    site.monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    return [doctor.disk(site.folder, CLOCK)]


def no_rights(site: Site) -> Iterable[Finding]:
    site.monkeypatch.setattr(doctor, "may_have_priority", lambda: False)
    return [doctor.realtime()]


def unset_clock(site: Site) -> Iterable[Finding]:
    site.monkeypatch.setattr(doctor, "utc_text", lambda: "1970-01-01T00:00:07Z")
    return [doctor.time_of_day()]


def swapped_port(site: Site) -> Iterable[Finding]:
    """Read a scale at the port of the gripper."""
    port = site.folder / "gripper"
    device = RobotiqConfig(port=str(port))
    emulator = emulate_gripper(RobotiqEmulatorConfig(device=device), CLOCK).emulator
    emulator.start()
    scale = {"kind": "scale", "address": str(port), "protocol": "kern", "rate_hz": 5.0}
    content = {**BenchFile.read(BENCHES / "gelsight.yaml").content, "force": scale, "hold_ms": 2000}
    bench = replace(bench_from(content, "bench.yaml"), preflight=replace(PREFLIGHT, timeout=0.3))
    try:
        checks.read_for(bench, "force", CLOCK, 0.1)
    except DeviceLost as error:
        return [Finding("force", "FAULT", str(error), doctor._cures(bench.row("force").config))]
    finally:
        emulator.close()
    return []


def shifted_camera(site: Site) -> Iterable[Finding]:
    (site.folder / "v4l" / "by-id").mkdir(parents=True)
    (site.folder / "video0").touch()
    (site.folder / "v4l" / "by-id" / "usb-046d_C270-video-index0").symlink_to(
        site.folder / "video0"
    )
    return site.filmed(1.0, 0.0, V4l2Config("/dev/video0"))


PREFLIGHT = BenchFile.read(BENCHES / "gelsight.yaml").bench.preflight
UP, TENFOLD, POUNDS = np.diag([1, 1, -1]), 10 * np.eye(3), np.eye(3) / 4.448
LYING = [[0, 0, 1], [0, 1, 0], [1, 0, 0]]
SWAPPED, TURNED = [[0, 1, 0], [1, 0, 0], [0, 0, 1]], [[0, -1, 0], [1, 0, 0], [0, 0, 1]]

# By the name of the fault: its findings, and the part named with words of its text and a cure.
FAULTS: dict[str, tuple[Callable[[Site], Any], tuple[str, str, str]]] = {
    "wrong IP of the arm": (
        lambda s: checks.network(s.changed(arm={"host": NOBODY})),
        ("arm", f"{NOBODY}:29999: ", "arm.host must be"),
    ),
    "wrong IP of the gauge": (
        lambda s: checks.network(s.changed(force={"host": NOBODY})),
        ("force", f"{NOBODY}:8080: ", "force.host must be"),
    ),
    "arm and gauge at one IP": (
        lambda s: checks.network(
            s.changed(arm={"host": "192.0.2.7"}, force={"host": "192.0.2.7"}), 0.01
        ),
        ("force", "arm has this address too", "its own address: force.host, arm.host"),
    ),
    "controller off": (lambda s: checks.arm(NOBODY, 1.0), ("arm", "refused", "switch the contr")),
    "old firmware": (
        arm_after("version", parts=[5, 3, 1, 0]),
        ("software", "5.3.1", "update PolyScope to 5.6"),
    ),
    "local mode": (
        arm_after("remote_control", on=False),
        ("remote", "no remote control", "Local > Remote Control"),
    ),
    "brakes on": (arm_after("emergency_stop"), ("power", "POWER_OFF", "releases the brakes")),
    "protective stop": (arm_after("protective_stop"), ("safety", "PROTECTIVE", "at the pendant")),
    "wrong TCP in the bench file": (
        lambda s: tool(s, s.changed(arm={"tcp": (0, 0, 0.09, 0, 0, 0)})),
        ("TCP", "bench file z 90.0 mm, pendant 100.0 mm", "arm.tcp"),
    ),
    "another tool than that of the file": (
        lambda s: tool(s, length=0.112),
        ("TCP", "caliper 112.0 mm", "measure flange to tip"),
    ),
    "wrong payload in the bench file": (
        lambda s: tool(s, s.changed(arm={"payload": 1.0})),
        ("payload", "bench file 1.00 kg, pendant 0.50 kg", "arm.payload_kg"),
    ),
    "heavier tool": (heavy, ("payload", "the arm feels 11.8 N", "about 1.70 kg")),
    "weight off": (
        lambda s: s.weighed(np.eye(3), laid=0),
        ("force weight", "nothing", "is the weight on the sensor"),
    ),
    "wrong sign": (
        lambda s: s.weighed(UP),
        ("force weight", "wrong sign", "by 180 degrees about x"),
    ),
    "10x unit": (
        lambda s: s.weighed(TENFOLD),
        ("force weight", "10 times too large", "10 times too small: another calibration"),
    ),
    "gauge in pounds-force": (
        lambda s: s.weighed(POUNDS),
        ("force weight", "0.225 times too small", "counts in pounds-force"),
    ),
    "gauge lying on its side": (
        lambda s: s.weighed(LYING),
        ("force weight", "along Fx", "channels or cables"),
    ),
    "wrong answer: another weight": (
        lambda s: s.weighed(np.eye(3), mass=0.2),
        ("force weight", "0.5 times too small", "100 g would fit"),
    ),
    "swapped axes": (lambda s: s.pushed(SWAPPED), ("force axes", "+x appears as +y", "swapped")),
    "turned gauge": (
        lambda s: s.pushed(TURNED),
        ("force axes", "+x appears as +y, +y as -x", "turned by 90 degrees"),
    ),
    "exposure too long": (
        lambda s: s.filmed(2.5, 0, V4l2Config(exposure=0.02)),
        ("camera exposure", "saturated", "a shorter camera.exposure_ms (now 20) below one period"),
    ),
    "exposure too short": (
        lambda s: s.filmed(0.2, 0),
        ("camera exposure", "brightest parts", "a longer exposure on the camera's own server"),
    ),
    "defocused": (lambda s: s.filmed(1, 5), ("camera focus", "px wide", "turn the lens")),
    "camera by a number": (
        shifted_camera,
        ("camera name", "after the next start", "usb-046d_C270-video-index0"),
    ),
    "camera at half rate": (
        lambda s: s.measured("camera", rate_hz=15.0),
        ("camera", "50% too slow", "lock the exposure"),
    ),
    "camera that sets itself": (
        lambda s: s.measured("camera", rate_hz=30.0, automatic=["exposure", "focus"]),
        ("camera", "automatic exposure, focus", "focus_automatic_continuous=0"),
    ),
    "gauge unplugged": (
        lambda s: s.measured("force", "force: no record for 0.6 s", rate_hz=0.0),
        ("force", "no record", f"ping {HOST}"),
    ),
    "swapped gauge port": (
        swapped_port,
        ("force", "no reading of a kern", "A name of /dev/serial/by-id stays the same"),
    ),
    "contact frame elsewhere": (elsewhere, ("contact", "x -20.00", "position_mm: [-120.000, -430")),
    "no rights": (no_rights, ("real time", "no rights", "rtprio 60")),
    "full disk": (full_disk, ("disk", "0 GB free", "free some space")),
    "clock never set": (unset_clock, ("clock", "1970", "timedatectl")),
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_is_named_with_its_cure(site: Site, name: str) -> None:
    found, (part, words, cure) = FAULTS[name]
    findings = found(site)
    findings = [findings] if isinstance(findings, Finding) else list(findings)
    named = next(each for each in findings if each.part == part)
    noted = part in ("real time", "camera name") or name == "camera that sets itself"
    assert named.state == ("note" if noted else "FAULT")
    assert words in named.text
    assert any(cure in each for each in named.cures)


def test_a_bench_without_a_fault_is_well(site: Site) -> None:
    network = list(checks.network(site.changed(force={"host": NOBODY})))
    assert (network[0].part, network[0].state) == ("arm", "well")
    found = [
        *checks.arm(HOST, 60.0),
        *tool(site),
        site.weighed(np.eye(3)),
        site.pushed(np.eye(3)),
        *site.filmed(1.0, 0.0),
        site.measured("camera", rate_hz=30.0),
    ]
    assert [each for each in found if each.state != "well" or each.cures] == []
