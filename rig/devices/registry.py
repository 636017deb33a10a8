"""Devices by the `kind` that a bench file names: one row each, ours and those of other packages.

A package registers a device as an entry point of the group `tactile.devices`: its name is the kind,
its value a `Device`. docs/how-to/add-a-device.md writes one.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

from rig.core.clock import Clock
from rig.core.driver import Driver
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES
from rig.devices.arm.settings import ArmConfig, PoseConfig, WrenchConfig
from rig.devices.camera.settings import MjpegConfig, V4l2Config
from rig.devices.force.settings import NetFtConfig, NidaqConfig, ScaleConfig
from rig.devices.gripper.settings import RobotiqConfig
from rig.devices.hid.settings import PedalConfig, SpaceMouseConfig
from rig.devices.taxels.settings import XelaConfig

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

# Entry points of devices in other packages.
GROUP = "tactile.devices"


@dataclass(frozen=True, slots=True)
class Device:
    """One kind of device."""

    settings: type[Any]
    """Dataclass of its keys in a bench file, with `KIND`; of a stream, one of `ForceSettings`,
    `TaxelSettings` and `CameraSettings`. Its module imports no vendor library."""
    driver: str = ""
    """`module:name` of what makes its `Driver` of settings and clock; empty: no stream."""
    emulator: str = ""
    """Module with `emulate(settings, clock)`, see `rig.core.emulation`; empty: another's serves."""
    cures: tuple[str, ...] = ()
    """Steps to try if it does not answer; `{at}` stands for its address."""
    example: Mapping[str, Any] = field(default_factory=dict)
    """Its keys on a mock bench, where `loopback` and `runfolder` stand for the addresses of its
    emulator: the contract suite tests it with these. Empty: it has tests of its own alone."""

    @property
    def kind(self) -> str:
        """Name of the device in a bench file."""
        return str(self.settings.KIND)

    @property
    def stream(self) -> str | None:
        """Kind of its stream; None: it has none."""
        return getattr(self.settings, "STREAM", None)

    def make_driver(self, config: Any, clock: Clock) -> Driver:
        """Return the driver of a device with these settings; its library is imported only here."""
        module, _, name = self.driver.partition(":")
        driver: Driver = getattr(import_module(module), name)(config, clock)
        return driver


_PLUGGED = (
    "plug the cable in again; is {at} this device? A name of /dev/serial/by-id stays the same"
)
_DIALOUT = "sudo usermod -a -G dialout $USER, then log in again"
_UR = (
    "switch the arm on, release its brakes, and choose remote control on the pendant",
    "ping {at}: this computer needs an address of its own in the arm's network",
    "let a firewall pass ports 29999, 30001 to 30004",
)
_HID = (
    "plug it in; lsusb shows vendor:product, which the bench file has as {at}",
    'a udev rule gives access: in /etc/udev/rules.d/70-tactile-rig.rules KERNEL=="hidraw*", '
    'ATTRS{idVendor}=="VENDOR", MODE="0660", TAG+="uaccess"; then plug it in again',
)

DEVICES = {
    device.kind: device
    for device in (
        Device(ArmConfig, "rig.devices.arm.reader:RtdePoseDriver", "rig.devices.arm.emulator", _UR),
        # Further readers of the same controller.
        Device(PoseConfig, "rig.devices.arm.reader:RtdePoseDriver", cures=_UR),
        Device(WrenchConfig, "rig.devices.arm.reader:RtdeWrenchDriver", cures=_UR),
        Device(
            NetFtConfig,
            "rig.devices.force.netft:NetFtDriver",
            "rig.devices.force.netft_emulator",
            (
                "ping {at}; the box shows its page in a browser at that address",
                "power of the box, cable of the sensor; UDP port 49152",
            ),
            {"host": "loopback", "http_port": 8080},
        ),
        Device(
            NidaqConfig,
            "rig.devices.force.nidaq:NidaqDriver",
            "rig.devices.force.nidaq_emulator",
            ("the device's name as NI MAX shows it; install the NI-DAQmx driver",),
            {"calibration": str(BENCHES / "mock-nano17.cal"), "grpc": "loopback:31763"},
        ),
        Device(
            ScaleConfig,
            "rig.devices.force.scale:ScaleDriver",
            "rig.devices.force.scale_emulator",
            (_PLUGGED, _DIALOUT, "baud rate and protocol as in the scale's own menu"),
            {"protocol": "kern", "address": "runfolder/scale", "rate_hz": 50.0},
        ),
        Device(
            V4l2Config,
            "rig.devices.camera.camera:V4l2Driver",
            cures=(
                "v4l2-ctl --list-devices: is it there, under {at}? "
                "Close other programs that show it",
                "sudo usermod -a -G video $USER, then log in again",
                "a USB 3 port of its own; exposure_ms below one period, or a brighter light",
            ),
        ),
        Device(
            MjpegConfig,
            "rig.devices.camera.camera:MjpegDriver",
            "rig.devices.camera.mjpeg_emulator",
            ("start the camera's server, and open {at} in a browser", "ping its address"),
            {"address": "http://loopback:8090/"},
        ),
        Device(
            XelaConfig,
            "rig.devices.taxels.xela:XelaDriver",
            "rig.devices.taxels.xela_emulator",
            ("start the vendor's server, xela_server, and open {at} in its viewer",),
            {"address": "ws://loopback:5000"},
        ),
        Device(
            RobotiqConfig,
            "rig.devices.gripper.robotiq:GripperStream",
            emulator="rig.devices.gripper.robotiq_emulator",
            cures=(
                "24 V of the gripper, and its USB cable; sudo usermod -a -G dialout $USER",
                "tactile grip closes it on the indenter",
            ),
        ),
        Device(PedalConfig, emulator="rig.devices.hid.hid_emulator", cures=_HID),
        Device(SpaceMouseConfig, emulator="rig.devices.hid.hid_emulator", cures=_HID),
    )
}


def device(kind: str) -> Device:
    """Return the device of a kind."""
    if kind in DEVICES:
        return DEVICES[kind]
    if kind in _entry_points():
        return _loaded(kind)
    raise ConfigError(f"kind: found {kind!r}; allowed: {', '.join(kinds())}")


def kinds() -> list[str]:
    """Return the kinds of all devices, those of installed packages included."""
    return [*DEVICES, *_entry_points()]


def settings_of(kind: Any, *, stream: str | None) -> dict[str, type[Any]]:
    """Return the settings of all devices with a stream of a kind, by kind of device.

    Without `stream`, it is any but the arm's own. Other packages are looked at if none of our
    devices has the `kind` that the bench file names.
    """
    devices = list(DEVICES.values())
    if isinstance(kind, str) and kind not in DEVICES:
        for name in _entry_points():
            try:
                devices.append(_loaded(name))
            except ConfigError:
                if name == kind:
                    raise
    return {
        each.kind: each.settings
        for each in devices
        if each.settings is not ArmConfig and each.stream is not None
        if stream in (None, each.stream)
    }


@functools.cache
def _entry_points() -> dict[str, EntryPoint]:
    from importlib.metadata import entry_points  # takes 0.1 s; most benches need none

    return {point.name: point for point in entry_points(group=GROUP)}


@functools.cache
def _loaded(kind: str) -> Device:
    point = _entry_points()[kind]
    try:
        loaded = point.load()
    except Exception as error:
        raise ConfigError(
            f"kind: {kind}: {point.value} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    if not isinstance(loaded, Device) or loaded.kind != kind:
        raise ConfigError(
            f"kind: {kind}: {point.value} is {loaded!r}; allowed: a Device whose settings have "
            f"KIND {kind!r}"
        )
    return loaded
