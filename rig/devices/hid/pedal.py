"""Driver of a foot pedal: a USB keyboard whose reports contain the keys that are down.

A pedal reports changes only: while it stays held or released, nothing is sent. Its absence shows
only when a read fails. So a pedal that cannot be read counts as released.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from rig.core.clock import SECOND_NS, Clock
from rig.core.errors import DeviceLost
from rig.devices.hid.device import HidDevice
from rig.devices.hid.reports import parse_keys
from rig.devices.hid.settings import PedalConfig

logger = logging.getLogger(__name__)

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
    """Number of presses."""
    releases: int = 0
    """Number of releases, unplugging included."""
    out_since_ns: int | None = None
    """Time at which it was found to be unplugged [ns]; None while it is plugged in."""

    def reported(self, down: bool) -> PedalState:
        """Return the state after a report that shows it down or up."""
        if down == self.down:
            return self
        if down:
            return replace(self, down=True, presses=self.presses + 1)
        return replace(self, down=False, releases=self.releases + 1)

    def unplugged(self, now_ns: int) -> PedalState:
        """Return the state after unplugging, which counts as a release."""
        return replace(self, down=False, releases=self.releases + 1, out_since_ns=now_ns)

    def plugged(self) -> PedalState:
        """Return the state after replugging: up, until it reports otherwise."""
        return replace(self, down=False, out_since_ns=None)


class PedalWatch:
    """Reads one pedal on a background thread.

    It calls `on_change` from there, with the state before and after each change.
    """

    def __init__(
        self,
        config: PedalConfig,
        clock: Clock,
        on_change: Callable[[PedalState, PedalState], None],
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
