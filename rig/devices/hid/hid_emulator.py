r"""Emulated pedal or SpaceMouse, for machines without hidraw: see rig/devices/hid/shim.py.

    python -m rig.mock.emulate hid_pedal \
        '{"device": {"kind": "hid_pedal", "device": "/tmp/pedal.hidraw"}}'

It is the device's side of a hidraw node: reports over a Unix socket, the report descriptor and the
identity in files next to it. Only a process with the shim preloaded sees a HID device there. Faults
are injected through rig.core.fault_injection, as are the actions of a hand or a foot:

    press, release                       the pedal
    push    x y z rx ry rz seconds       the cap, fractions of full deflection; repeated at 60 Hz
    button  number                       down and up again
"""

import contextlib
import shutil
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rig.core.clock import SECOND_NS, Clock, Pacer
from rig.core.emulation import Emulator, EmulatorConfig, Served
from rig.core.errors import ConfigError
from rig.core.fault_injection import FaultInjector, corrupted_bytes
from rig.devices.hid.reports import Axes, CapReport, emit_cap, emit_keys
from rig.devices.hid.settings import PedalConfig, SpaceMouseConfig

_RATE_HZ = 60.0
# The letter b, which these pedals send by default.
_KEY = 0x05

_KEYBOARD = bytes.fromhex(
    # USB HID 1.11, appendix E.6: keyboard, modifiers, reserved byte, five lights, six keys.
    "05010906a1010507"
    "19e029e715002501"
    "7501950881029501"
    "7508810395057501"
    "0508190129059102"
    "9501750391039506"
    "7508150025650507"
    "190029658100c0"
)
_CAP = bytes.fromhex(
    # Multi-axis controller: report 1 x y z, report 2 rx ry rz (-350 to 350, relative), 3 buttons.
    "05010908a101" "a1008501" "16a2fe265e01" "093009310932" "75109503" "8106c0"
    "a1008502" "16a2fe265e01" "093309340935" "75109503" "8106c0"
    "a1028503" "0501" "0509" "19012910" "15002501" "75019510" "8102c0" "c0"
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of a device, as reported by the kernel."""

    name: str
    vendor: int
    product: int
    descriptor: bytes

    @property
    def uevent(self) -> str:
        """Content of the device's uevent file in sysfs."""
        return (
            f"DRIVER=hid-generic\nHID_ID=0003:{self.vendor:08X}:{self.product:08X}\n"
            f"HID_NAME={self.name}\nHID_PHYS=emulated\nHID_UNIQ=\n"
        )


KINDS = {
    "pedal": Identity("PCsensor FootSwitch", 0x3553, 0xB001, _KEYBOARD),
    "spacemouse": Identity("3Dconnexion SpaceMouse Compact", 0x256F, 0xC635, _CAP),
}


class HidEmulator(Emulator):
    """Emulated HID device, a `pedal` or `spacemouse`; the path of its node ends with `.hidraw`."""

    def __init__(self, kind: str, path: Path, clock: Clock, *, seed: int = 0) -> None:
        if kind not in KINDS:
            raise ConfigError(f"kind: found {kind!r}; allowed: {', '.join(KINDS)}")
        if path.suffix != ".hidraw":
            raise ConfigError(f"{path}: allowed: a name that ends with .hidraw")
        self.faults = FaultInjector[bytes](clock, spoil=corrupted_bytes, seed=seed)
        super().__init__()
        self._kind = kind
        self._path = path
        self._clock = clock
        self._listener: socket.socket | None = None
        self._clients: list[socket.socket] = []
        self._lock = threading.RLock()
        self._push: tuple[Axes, Axes] | None = None
        self._push_until_ns = 0

    @property
    def address(self) -> str:
        """Node for a driver to open."""
        return str(self._path)

    def start(self) -> None:
        """Create the node and serve."""
        self._plug()
        self._run_threads(self._run)

    def inject(self, fault: str, **values: Any) -> dict[str, Any]:
        """Inject a fault or a person's action, and return the emulator's state."""
        own: dict[str, Callable[[], None]] = {
            "press": lambda: self.send(emit_keys([_KEY])),
            "release": lambda: self.send(emit_keys([])),
            "push": lambda: self._start_push(**values),
            "button": lambda: self._press_button(int(values["number"])),
        }
        if fault in own:
            own[fault]()
            line = self.faults.inject("state")
        else:
            line = self.faults.inject(fault, **values)
        return {**line, "clients": len(self._clients)}

    def send(self, report: bytes) -> None:
        """Send one report to every client that has the node open."""
        for message in self.faults.passed(report):
            with self._lock:
                for client in tuple(self._clients):
                    try:
                        client.send(message, socket.MSG_NOSIGNAL | socket.MSG_DONTWAIT)
                    except BlockingIOError:
                        # The client's queue is full: the kernel drops a report too.
                        continue
                    except OSError:
                        client.close()
                        self._clients.remove(client)

    def _start_push(self, seconds: float = 1.0, **axes: float) -> None:
        unknown = sorted(set(axes) - {"x", "y", "z", "rx", "ry", "rz"})
        if unknown:
            raise ValueError(f"push: unknown {unknown}; known: x y z rx ry rz seconds")
        x, y, z, rx, ry, rz = (float(axes.get(n, 0.0)) for n in ("x", "y", "z", "rx", "ry", "rz"))
        with self._lock:
            self._push = ((x, y, z), (rx, ry, rz))
            self._push_until_ns = self._clock.now_ns() + round(float(seconds) * SECOND_NS)

    def _press_button(self, number: int) -> None:
        self.send(emit_cap(CapReport(buttons=frozenset({number}))))
        self.send(emit_cap(CapReport(buttons=frozenset())))

    def _plug(self) -> None:
        identity = KINDS[self._kind]
        sysfs = self._path.with_name(f"{self._path.name}.sys") / "device"
        sysfs.mkdir(parents=True, exist_ok=True)
        (sysfs / "report_descriptor").write_bytes(identity.descriptor)
        (sysfs / "uevent").write_text(identity.uevent)
        self._path.unlink(missing_ok=True)
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        listener.settimeout(0.0)
        listener.bind(str(self._path))
        listener.listen(4)
        with self._lock:
            self._listener = listener

    def _release(self) -> None:
        with self._lock:
            if self._listener is not None:
                self._listener.close()
                self._listener = None
                self._path.unlink(missing_ok=True)
                shutil.rmtree(self._path.with_name(f"{self._path.name}.sys"), ignore_errors=True)
            for client in self._clients:
                client.close()
            self._clients.clear()

    def _run(self) -> None:
        pacer = Pacer(self._clock, _RATE_HZ)
        while not self._ending.is_set():
            pacer.wait()
            self.missed = pacer.missed
            if self.faults.unplugged:
                self._release()
                continue
            if self._listener is None:
                self._plug()
            with contextlib.suppress(OSError):
                if self._listener is not None:
                    client, _ = self._listener.accept()
                    with self._lock:
                        self._clients.append(client)
            self._repeat_push()

    def _repeat_push(self) -> None:
        with self._lock:
            push = self._push
            if push is None:
                return
            if self._clock.now_ns() > self._push_until_ns:
                # Like some models, send nothing more, not even zeros.
                self._push = None
                return
        self.send(emit_cap(CapReport(shift=push[0])))
        self.send(emit_cap(CapReport(turn=push[1])))


@dataclass(frozen=True, slots=True)
class HidEmulatorConfig(EmulatorConfig):
    """Device, and the node to create."""

    device: PedalConfig | SpaceMouseConfig


def emulate(settings: HidEmulatorConfig, clock: Clock) -> Served:
    """Return the emulated device."""
    kind = "pedal" if isinstance(settings.device, PedalConfig) else "spacemouse"
    emulator = HidEmulator(kind, Path(settings.device.device), clock, seed=settings.seed)
    return Served(kind, emulator, emulator.inject)
