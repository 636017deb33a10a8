"""When a pedal that must be held counts as held. Pure, no I/O. Not a safety function."""

from __future__ import annotations

from rig.hid.watch import PedalState


class DeadMan:
    """Armed by a press, disarmed by the first release or unplugging, however short.

    A press counts when it comes after the last release that was seen here, and after `disarm`: who
    kept the pedal down meanwhile has to let go of it first.
    """

    def __init__(self) -> None:
        self._presses_before = 0
        self._releases_at_arming: int | None = None

    def held(self, state: PedalState) -> bool:
        """Whether it was armed and has been held ever since."""
        return state.down and state.releases == self._releases_at_arming

    def armed(self, state: PedalState) -> bool:
        """The same, taking a fresh press for the arming; for when the arm stands still."""
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
        """Ask for a press that is yet to come."""
        self._releases_at_arming = None
        self._presses_before = state.presses
