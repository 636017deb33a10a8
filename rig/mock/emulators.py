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
class Stage:
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


def _arm(config: ArmConfig, stage: Stage) -> list[str]:
    bench = stage.bench
    start = compose(bench.contact_frame, (0.0, 0.0, _START_HEIGHT, *bench.tool_rotation))
    return [
        "rig.devices.arm.emulator",
        *stage.common,
        *("--state", str(stage.arm)),
        *("--pose", *(repr(float(value)) for value in start)),
        *("--tcp", *(repr(float(value)) for value in config.tcp)),
    ]


def _netft(config: NetFtConfig, stage: Stage) -> list[str]:
    return [
        "rig.devices.force.netft_emulator",
        *stage.common,
        *stage.faults("force"),
        *("--http-port", str(config.http_port)),
        *("--udp-port", str(config.udp_port)),
        *(("--noise", str(stage.noise.force)) if stage.noise else ()),
    ]


def _nidaq(config: NidaqConfig, stage: Stage) -> list[str]:
    if config.grpc is None:
        raise ConfigError(
            "force.grpc: missing; allowed: loopback:31763, the address of a mock bench's NI card"
        )
    return [
        "rig.devices.force.nidaq_emulator",
        *stage.common,
        *stage.faults("force"),
        *("--port", config.grpc.rpartition(":")[2]),
        *("--device", config.device),
        *("--calibration", config.calibration),
        *(("--noise", str(stage.noise.force)) if stage.noise else ()),
    ]


def _ati_serial(config: AtiSerialConfig, stage: Stage) -> list[str]:
    return [
        "rig.devices.force.ati_serial_emulator",
        *stage.common,
        *stage.faults("force"),
        *("--link", config.address),
        *("--counts-per-n", str(config.counts_per_n)),
        *("--counts-per-n-mm", str(config.counts_per_n_mm)),
        *("--baud", str(config.baud)),
        *("--rate-hz", str(config.rate_hz)),
        *(("--noise", str(stage.noise.force)) if stage.noise else ()),
    ]


def _mjpeg(config: CameraConfig, stage: Stage) -> list[str]:
    shown = ["--view", str(stage.spec)]
    if stage.bench.world is not None and (delay := stage.bench.world.camera_delay):
        shown += ["--delay-ms", repr(from_si(delay, "ms"))]
    if stage.sources.camera is not None:
        motion = stage.sources.camera_motion
        shown = ["--source", str(stage.sources.camera), "--motion", motion]
    return [
        "rig.devices.camera.mjpeg_emulator",
        *stage.common,
        *stage.faults("camera"),
        *("--port", str(urlsplit(config.address).port)),
        *("--fps", str(config.rate_hz)),
        *shown,
    ]


def _xela(config: XelaConfig, stage: Stage) -> list[str]:
    felt = ["--noise", str(stage.noise.counts)] if stage.noise else []
    if stage.sources.taxels is not None:
        felt = ["--source", str(stage.sources.taxels)]
    return [
        "rig.devices.taxels.xela_emulator",
        *stage.common,
        *stage.faults("taxels"),
        *("--port", str(urlsplit(config.address).port)),
        *("--rate-hz", str(config.rate_hz)),
        *felt,
    ]


def _robotiq(config: RobotiqConfig, stage: Stage) -> list[str]:
    return [
        "rig.devices.gripper.robotiq_emulator",
        *stage.common,
        *stage.faults("gripper"),
        *("--link", config.port),
        *("--slave", str(config.slave)),
        *("--object", str(config.object_mock)),
        "--holding",
    ]


def _hid(kind: str, device: str, stage: Stage) -> list[str]:
    if not device.endswith(".hidraw"):
        raise ConfigError(
            f"{kind}.device: found {device!r}; allowed on a mock bench: runfolder/{kind}.hidraw"
        )
    return [
        "rig.devices.hid.emulator",
        *stage.common,
        *stage.faults(kind),
        *("--kind", kind),
        *("--socket", device),
    ]


def _pedal(config: PedalConfig, stage: Stage) -> list[str]:
    return _hid("pedal", config.device, stage)


def _spacemouse(config: SpaceMouseConfig, stage: Stage) -> list[str]:
    return _hid("spacemouse", config.device, stage)


_EMULATORS: dict[type, Callable[[Any, Stage], list[str]]] = {
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


def world_commands(stage: Stage) -> dict[str, list[str]]:
    """Return module and arguments of the World's process, and of its solver if it has one."""
    motion = ["--spec", str(stage.spec), "--arm", str(stage.arm)]
    truth = ["--truth", str(stage.truth)] if stage.truth else []
    commands = {"world": ["rig.mock.world.host", *motion, "--world", str(stage.world), *truth]}
    if isinstance(stage.bench.world, SimulatedSpec):
        commands["solver"] = ["rig.mock.world.solver", *motion]
    return commands


def emulator_commands(stage: Stage) -> dict[str, list[str]]:
    """Return module and arguments of the emulator of every device, by the device's key."""
    bench = stage.bench
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
        name: _EMULATORS[type(config)](config, stage)
        for name, config in devices.items()
        if config is not None
    }
