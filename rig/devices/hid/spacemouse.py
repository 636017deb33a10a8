"""Driver of a SpaceMouse: current deflection of its cap, zero once it falls silent.

Many models stop sending when the cap is released, some without a last report of zeros. So the last
report is valid for `silence` only.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

from rig.core.clock import SECOND_NS, Clock
from rig.devices.hid.device import HidDevice
from rig.devices.hid.reports import Axes, parse_cap
from rig.devices.hid.settings import SpaceMouseConfig

logger = logging.getLogger(__name__)

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
            found = parse_cap(report)
        except ValueError as error:
            self.garbage += 1
            if self.garbage == 1:
                logger.warning("SpaceMouse: %s", error)
            # An invalid report may have been a release.
            self._shift = self._turn = _ZERO
            return frozenset()
        now_ns = self._clock.now_ns()
        if found.shift is not None:
            self._shift, self._shift_ns = self._quiet(found.shift), now_ns
        if found.turn is not None:
            self._turn, self._turn_ns = self._quiet(found.turn), now_ns
        if found.buttons is None:
            return frozenset()
        pressed, self._held = found.buttons - self._held, found.buttons
        return pressed

    def _quiet(self, axes: Axes) -> Axes:
        """Return `axes` without the dead zone, the rest scaled so that full stays full."""
        zone = self._config.dead_zone

        def quiet(value: float) -> float:
            beyond = (abs(value) - zone) / (1 - zone)
            return 0.0 if beyond <= 0 else (beyond if value > 0 else -beyond)

        x, y, z = axes
        return (quiet(x), quiet(y), quiet(z))
