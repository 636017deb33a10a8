"""Drivers of HID devices, foot pedal and SpaceMouse, through hidapi's hidraw backend.

The module is `hidraw`, not `hid`: the wheel's `hid` uses libusb, which would detach the device from
the kernel and does not see virtual devices. Reading needs a permission that a udev rule gives:

    KERNEL=="hidraw*", ATTRS{idVendor}=="256f", MODE="0660", GROUP="plugdev"

A pedal is a USB keyboard that reports changes only: while it stays held or released, nothing is
sent, and its absence shows only when a read fails. So a pedal that cannot be read counts as
released. Many models of SpaceMouse stop sending when the cap is released, some without a last
report of zeros. So the last report is valid for `silence` only.
"""

import logging
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import hidraw

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import DeviceLost
from rig.devices.hid.reports import Axes, parse_cap, parse_keys
from rig.devices.hid.settings import PedalConfig, SpaceMouseConfig

logger = logging.getLogger(__name__)

# Length of a full-speed USB report [bytes].
_LONGEST = 64


class HidDevice:
    """One HID device, `/dev/hidrawN` or `vendor:product`, read report by report.

    `usage` has page and usage of the required interface, if a device has several.
    """

    def __init__(self, device: str, what: str, usage: tuple[int, int]) -> None:
        self._device = device
        self._what = what
        self._usage = usage
        self._handle: hidraw.device | None = None
        self.path = ""
        """Path of the opened node."""

    def open(self) -> None:
        """Find and open the device."""
        self.close()
        self.path = self._device if "/" in self._device else self._path_by_ids()
        handle = hidraw.device()
        try:
            handle.open_path(self.path.encode())
        except OSError as error:
            raise DeviceLost(f"{self._where}: {error}{self._hint()}") from error
        self._handle = handle

    def report(self, timeout: float) -> bytes:
        """Return the next report, empty if none comes within `timeout` [s]."""
        if self._handle is None:
            raise DeviceLost(f"{self._where}: not open")
        try:
            return bytes(self._handle.read(_LONGEST, max(1, round(1e3 * timeout))))
        except (OSError, ValueError) as error:
            raise DeviceLost(f"{self._where}: {error}; is it plugged in?") from error

    def close(self) -> None:
        """Close the device; may be called twice."""
        if self._handle is not None:
            self._handle.close()
            self._handle = None

    @property
    def _where(self) -> str:
        return f"{self._what} at {self._device}"

    def _path_by_ids(self) -> str:
        vendor, product = (int(part, 16) for part in self._device.split(":"))
        nodes = hidraw.enumerate(vendor, product)
        if not nodes:
            ids = sorted(
                {f"{node['vendor_id']:04x}:{node['product_id']:04x}" for node in hidraw.enumerate()}
            )
            raise DeviceLost(
                f"{self._where}: not found among {', '.join(ids) or 'no HID devices at all'}; is "
                "it plugged in?"
            )
        matches = [
            node for node in nodes if (node["usage_page"], node["usage"]) == self._usage
        ] or nodes
        return str(matches[0]["path"].decode())

    def _hint(self) -> str:
        if self.path.endswith(".hidraw"):
            return (
                f": {self.path} is an emulated node; is it plugged in? Only a process with the "
                "shim sees it: export LD_PRELOAD=$(python -m rig.devices.hid.shim)"
            )
        if not os.path.exists(self.path):
            return f": {self.path} is not there; is it plugged in?"
        if os.access(self.path, os.R_OK | os.W_OK):
            return f": {self.path} is not a HID device, or its driver has released it"
        vendor = self._device[:4] if ":" in self._device else "<vendor, see lsusb>"
        return (
            f": {self.path} may not be opened; put this line into "
            f'/etc/udev/rules.d/70-tactile-rig.rules and plug it in again: KERNEL=="hidraw*", '
            f'ATTRS{{idVendor}}=="{vendor}", MODE="0660", GROUP="plugdev"'
        )


_KEYBOARD = (0x01, 0x06)


class PedalDriver(HidDevice):
    """One pedal."""

    def __init__(self, config: PedalConfig) -> None:
        super().__init__(config.device, "foot pedal", _KEYBOARD)
        self._config = config
        self.garbage = 0
        """Number of reports that were not from a keyboard; each counted as a release."""

    def read(self, timeout: float) -> bool | None:
        """Return True if the next report shows it down; None if none comes in `timeout` [s]."""
        report = self.report(timeout)
        if not report:
            return None
        try:
            keys = parse_keys(report)
        except ValueError as error:
            self.garbage += 1
            if self.garbage == 1:
                logger.warning("foot pedal: %s; taken for a release", error)
            return False
        return self._config.key in keys if self._config.key else bool(keys)

    def describe(self) -> dict[str, object]:
        """Return properties for the session."""
        return {"kind": self._config.KIND, "mode": self._config.mode, "path": self.path}


# Watching of the foot pedal on a background thread, through unplugging and replugging.

# Longest wait of a read; a press or a release ends it at once [s].
_WAIT = 0.1
# Interval between two attempts to find an unplugged pedal [s].
_RETRY = 0.5


@dataclass(frozen=True, slots=True)
class PedalState:
    """Known state of the pedal, with counters so that no quick release and press is missed."""

    down: bool = False
    presses: int = 0
    releases: int = 0
    """Number of releases, unplugging included."""
    out_since_ns: int | None = None
    """Time at which it was found to be unplugged [ns]; None while it is plugged in."""

    def reported(self, down: bool) -> Self:
        """Return the state after a report that shows it down or up."""
        if down == self.down:
            return self
        if down:
            return replace(self, down=True, presses=self.presses + 1)
        return replace(self, down=False, releases=self.releases + 1)

    def unplugged(self, now_ns: int) -> Self:
        """Return the state after unplugging, which counts as a release."""
        return replace(self, down=False, releases=self.releases + 1, out_since_ns=now_ns)

    def plugged(self) -> Self:
        """Return the state after replugging: up, until it reports otherwise."""
        return replace(self, down=False, out_since_ns=None)


class PedalWatch:
    """Reads a pedal on a thread, which calls `on_change` with the states before and after."""

    def __init__(
        self, config: PedalConfig, clock: Clock, on_change: Callable[[PedalState, PedalState], None]
    ) -> None:
        self._config = config
        self._clock = clock
        self._on_change = on_change
        self._driver = PedalDriver(config)
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self.state = PedalState()
        """Current state; replaced as a whole, so that any thread may read it."""

    def open(self) -> dict[str, Any]:
        """Open the pedal, watch it from now on, and return its properties."""
        self._driver.open()
        description = self._driver.describe()
        logger.info("preflight  foot pedal at %s (%s)", description["path"], self._config.mode)
        self._thread = threading.Thread(target=self._run, name="pedal")
        self._thread.start()
        return description

    @property
    def out_for(self) -> float | None:
        """Time since it was unplugged [s]; None while it is plugged in."""
        since_ns = self.state.out_since_ns
        return None if since_ns is None else (self._clock.now_ns() - since_ns) / SECOND_NS

    def close(self) -> None:
        """Stop watching it; may be called twice."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._driver.close()

    def _run(self) -> None:
        while not self._ending.is_set():
            if self.state.out_since_ns is not None:
                self._look_for_it()
                continue
            try:
                down = self._driver.read(_WAIT)
            except DeviceLost as error:
                logger.warning("%s", error)
                self._become(self.state.unplugged(self._clock.now_ns()))
            else:
                if down is not None:
                    self._become(self.state.reported(down))

    def _look_for_it(self) -> None:
        try:
            self._driver.open()
        except DeviceLost:
            self._ending.wait(_RETRY)
        else:
            logger.info("the foot pedal is back")
            self._become(self.state.plugged())

    def _become(self, state: PedalState) -> None:
        before, self.state = self.state, state
        if state != before:
            self._on_change(before, state)


# Logic of a pedal that must be held. Pure, no I/O. Not a safety function.


class DeadMan:
    """Dead-man logic: armed by a press, disarmed by the first release or unplugging, however short.

    A press counts only after the last observed release, and after `disarm`: a person who kept the
    pedal down meanwhile has to release it first.
    """

    def __init__(self) -> None:
        self._presses_before = 0
        self._releases_at_arming: int | None = None

    def held(self, state: PedalState) -> bool:
        """Return True if it was armed and has been held ever since."""
        return state.down and state.releases == self._releases_at_arming

    def armed(self, state: PedalState) -> bool:
        """Return like `held`, but let a fresh press arm it; for when the arm is at rest."""
        if self.held(state):
            return True
        if self._releases_at_arming is not None:
            self._releases_at_arming = None
            # Down again already: that press is a fresh one.
            self._presses_before = state.presses - state.down
        if state.down and state.presses > self._presses_before:
            self._releases_at_arming = state.releases
            return True
        return False

    def disarm(self, state: PedalState) -> None:
        """Require a press later than `state`."""
        self._releases_at_arming = None
        self._presses_before = state.presses


_MULTI_AXIS = (0x01, 0x08)
_ZERO: Axes = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Cap:
    """State of the cap at one moment."""

    shift: Axes = _ZERO
    """x right, y away from the user, z up; -1 to 1, zero inside the dead zone."""
    turn: Axes = _ZERO
    """Rotation about these axes, right-handed."""
    pressed: frozenset[int] = frozenset()
    """Numbers of the buttons pressed since the last `read`, from 0."""


class SpaceMouseDriver(HidDevice):
    """One SpaceMouse."""

    def __init__(self, config: SpaceMouseConfig, clock: Clock) -> None:
        super().__init__(config.device, "SpaceMouse", _MULTI_AXIS)
        self._config = config
        self._clock = clock
        self._shift = self._turn = _ZERO
        self._shift_ns = self._turn_ns = 0
        self._held: frozenset[int] = frozenset()
        self.garbage = 0
        """Number of reports that were not from a SpaceMouse."""

    def read(self, timeout: float) -> Cap:
        """Return the state of the cap after waiting up to `timeout` [s] for a report."""
        pressed: frozenset[int] = frozenset()
        report = self.report(timeout)
        while report:
            pressed |= self._take(report)
            report = self.report(0.0)
        now_ns = self._clock.now_ns()
        limit_ns = round(self._config.silence * SECOND_NS)
        return Cap(
            shift=self._shift if now_ns - self._shift_ns <= limit_ns else _ZERO,
            turn=self._turn if now_ns - self._turn_ns <= limit_ns else _ZERO,
            pressed=pressed,
        )

    def _take(self, report: bytes) -> frozenset[int]:
        """Process a report and return the buttons that it newly shows as pressed."""
        try:
            cap = parse_cap(report)
        except ValueError as error:
            self.garbage += 1
            if self.garbage == 1:
                logger.warning("SpaceMouse: %s", error)
            # An invalid report may have been a release.
            self._shift = self._turn = _ZERO
            return frozenset()
        now_ns = self._clock.now_ns()
        if cap.shift is not None:
            self._shift, self._shift_ns = self._quiet(cap.shift), now_ns
        if cap.turn is not None:
            self._turn, self._turn_ns = self._quiet(cap.turn), now_ns
        if cap.buttons is None:
            return frozenset()
        pressed, self._held = cap.buttons - self._held, cap.buttons
        return pressed

    def _quiet(self, axes: Axes) -> Axes:
        """Return `axes` without the dead zone, the rest scaled so that full stays full."""
        zone = self._config.dead_zone

        def quiet(value: float) -> float:
            beyond = (abs(value) - zone) / (1 - zone)
            return 0.0 if beyond <= 0 else (beyond if value > 0 else -beyond)

        x, y, z = axes
        return (quiet(x), quiet(y), quiet(z))
