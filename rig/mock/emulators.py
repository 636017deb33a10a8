"""Commands that start the emulators, one function per kind of device in a bench file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rig.bench.bench import Bench
from rig.bench.worlds import Noise, SimulatedSpec
from rig.core.config import from_si
from rig.core.emulation import PORTS
from rig.core.errors import ConfigError
from rig.core.geometry import compose
from rig.core.sources import Sources
from rig.devices.arm.settings import ArmConfig
from rig.devices.camera.settings import CameraConfig
from rig.devices.force.settings import AtiSerialConfig, NetFtConfig, NidaqConfig
from rig.devices.gripper.settings import RobotiqConfig
from rig.devices.hid.settings import PedalConfig, SpaceMouseConfig
from rig.devices.taxels.settings import XelaConfig

# Start height of the arm above the middle of the sensor [m].
_START_HEIGHT = 0.03


@dataclass(frozen=True, slots=True)
class MockBenchSpec:
    """Common settings of the emulators of one mock bench."""

    bench: Bench
    """The bench, with addresses filled in."""
    host: str
    """Loopback address they listen on."""
    folder: Path
    """Run folder; links to ptys are made here."""
    spec: Path
    """JSON file of the World."""
    arm: Path
    """ARM_TRUTH record."""
    world: Path
    """WORLD_STATE record."""
    sources: Sources = field(default_factory=Sources)
    """Real recordings to play."""
    truth: Path | None = None
    """File to log the World's truth to."""

    @property
    def common(self) -> list[str]:
        """Options common to all emulators."""
        return ["--host", self.host, "--world", str(self.world)]

    def faults(self, device: str) -> list[str]:
        """Return the option that opens a device's fault port."""
        return ["--fault-port", str(PORTS[device])]

    @property
    def noise(self) -> Noise | None:
        """Noise of the instruments."""
        return None if self.bench.world is None else self.bench.world.noise


def _arm(config: ArmConfig, bench_spec: MockBenchSpec) -> list[str]:
    bench = bench_spec.bench
    start = compose(bench.contact_frame, (0.0, 0.0, _START_HEIGHT, *bench.tool_rotation))
    return [
        "rig.devices.arm.emulator",
        *bench_spec.common,
        *("--state", str(bench_spec.arm)),
        *("--pose", *(repr(float(value)) for value in start)),
        *("--tcp", *(repr(float(value)) for value in config.tcp)),
    ]


def _netft(config: NetFtConfig, bench_spec: MockBenchSpec) -> list[str]:
    return [
        "rig.devices.force.netft_emulator",
        *bench_spec.common,
        *bench_spec.faults("force"),
        *("--http-port", str(config.http_port)),
        *("--udp-port", str(config.udp_port)),
        *(("--noise", str(bench_spec.noise.force)) if bench_spec.noise else ()),
    ]


def _nidaq(config: NidaqConfig, bench_spec: MockBenchSpec) -> list[str]:
    if config.grpc is None:
        raise ConfigError(
            "force.grpc: missing; allowed: loopback:31763, the address of a mock bench's NI card"
        )
    return [
        "rig.devices.force.nidaq_emulator",
        *bench_spec.common,
        *bench_spec.faults("force"),
        *("--port", config.grpc.rpartition(":")[2]),
        *("--device", config.device),
        *("--calibration", config.calibration),
        *(("--noise", str(bench_spec.noise.force)) if bench_spec.noise else ()),
    ]


def _ati_serial(config: AtiSerialConfig, bench_spec: MockBenchSpec) -> list[str]:
    return [
        "rig.devices.force.ati_serial_emulator",
        *bench_spec.common,
        *bench_spec.faults("force"),
        *("--link", config.address),
        *("--counts-per-n", str(config.counts_per_n)),
        *("--counts-per-n-mm", str(config.counts_per_n_mm)),
        *("--baud", str(config.baud)),
        *("--rate-hz", str(config.rate_hz)),
        *(("--noise", str(bench_spec.noise.force)) if bench_spec.noise else ()),
    ]


def _mjpeg(config: CameraConfig, bench_spec: MockBenchSpec) -> list[str]:
    shown = ["--view", str(bench_spec.spec)]
    if bench_spec.bench.world is not None and (delay := bench_spec.bench.world.camera_delay):
        shown += ["--delay-ms", repr(from_si(delay, "ms"))]
    if bench_spec.sources.camera is not None:
        motion = bench_spec.sources.camera_motion
        shown = ["--source", str(bench_spec.sources.camera), "--motion", motion]
    return [
        "rig.devices.camera.mjpeg_emulator",
        *bench_spec.common,
        *bench_spec.faults("camera"),
        *("--port", str(urlsplit(config.address).port)),
        *("--fps", str(config.rate_hz)),
        *shown,
    ]


def _xela(config: XelaConfig, bench_spec: MockBenchSpec) -> list[str]:
    felt = ["--noise", str(bench_spec.noise.counts)] if bench_spec.noise else []
    if bench_spec.sources.taxels is not None:
        felt = ["--source", str(bench_spec.sources.taxels)]
    return [
        "rig.devices.taxels.xela_emulator",
        *bench_spec.common,
        *bench_spec.faults("taxels"),
        *("--port", str(urlsplit(config.address).port)),
        *("--rate-hz", str(config.rate_hz)),
        *felt,
    ]


def _robotiq(config: RobotiqConfig, bench_spec: MockBenchSpec) -> list[str]:
    return [
        "rig.devices.gripper.robotiq_emulator",
        *bench_spec.common,
        *bench_spec.faults("gripper"),
        *("--link", config.port),
        *("--slave", str(config.slave)),
        *("--object", str(config.object_mock)),
        "--holding",
    ]


def _hid(kind: str, device: str, bench_spec: MockBenchSpec) -> list[str]:
    if not device.endswith(".hidraw"):
        raise ConfigError(
            f"{kind}.device: found {device!r}; allowed on a mock bench: runfolder/{kind}.hidraw"
        )
    return [
        "rig.devices.hid.emulator",
        *bench_spec.common,
        *bench_spec.faults(kind),
        *("--kind", kind),
        *("--socket", device),
    ]


def _pedal(config: PedalConfig, bench_spec: MockBenchSpec) -> list[str]:
    return _hid("pedal", config.device, bench_spec)


def _spacemouse(config: SpaceMouseConfig, bench_spec: MockBenchSpec) -> list[str]:
    return _hid("spacemouse", config.device, bench_spec)


_EMULATORS: dict[type, Callable[[Any, MockBenchSpec], list[str]]] = {
    ArmConfig: _arm,
    NetFtConfig: _netft,
    NidaqConfig: _nidaq,
    AtiSerialConfig: _ati_serial,
    CameraConfig: _mjpeg,
    XelaConfig: _xela,
    RobotiqConfig: _robotiq,
    PedalConfig: _pedal,
    SpaceMouseConfig: _spacemouse,
}


def world_commands(bench_spec: MockBenchSpec) -> dict[str, list[str]]:
    """Return module and arguments of the World's process, and of its solver if it has one."""
    motion = ["--spec", str(bench_spec.spec), "--arm", str(bench_spec.arm)]
    truth = ["--truth", str(bench_spec.truth)] if bench_spec.truth else []
    commands = {"world": ["rig.mock.world.host", *motion, "--world", str(bench_spec.world), *truth]}
    if isinstance(bench_spec.bench.world, SimulatedSpec):
        commands["solver"] = ["rig.mock.world.solver", *motion]
    return commands


def emulator_commands(bench_spec: MockBenchSpec) -> dict[str, list[str]]:
    """Return module and arguments of the emulator of every device, by the device's key."""
    bench = bench_spec.bench
    devices = {
        "arm": bench.arm,
        "force": bench.force,
        "camera": bench.camera,
        "taxels": bench.taxels,
        "gripper": bench.gripper,
        "pedal": bench.pedal,
        "spacemouse": bench.jog,
    }
    return {
        name: _EMULATORS[type(config)](config, bench_spec)
        for name, config in devices.items()
        if config is not None
    }
