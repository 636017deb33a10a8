"""What watches beside the streams: the gripper that holds the indenter, and the foot pedal.

They record nothing. Each has a thread of its own that notices; the walk, told by `wake` at once,
asks `check` and acts. What they were is in the session's run entry, under `devices`.
"""

from __future__ import annotations

import contextlib
import socket
from typing import TYPE_CHECKING, Any

from rig.acquire.control import Control
from rig.bench.bench import Bench
from rig.core.clock import Clock
from rig.core.errors import DeviceLost, SafetyStop
from rig.devices.hid.settings import PedalConfig

if TYPE_CHECKING:
    from rig.devices.gripper.robotiq import GripWatch
    from rig.devices.hid.pedal import DeadMan, PedalState, PedalWatch

# Who pauses, when the pedal does.
PEDAL = "foot pedal"


class Released(Exception):
    """The dead-man pedal is not held: the arm must not press."""


class Sentinels:
    """The gripper and the pedal of a bench, as far as it has them; a context manager.

    Args:
        bench: The bench, with addresses filled in.
        control: Paused by a pedal of mode `pause`.
        clock: Clock.
    """

    def __init__(self, bench: Bench, control: Control, clock: Clock) -> None:
        self._timeout = bench.preflight.timeout
        self._control = control
        self._waker, self.wake = socket.socketpair()
        """`wake` can be read from when there is something to `check`."""
        for end in (self._waker, self.wake):
            end.setblocking(False)
        self._grip: GripWatch | None = None
        self._pedal: PedalWatch | None = None
        self._dead_man: DeadMan | None = None
        self._config: PedalConfig | None = bench.pedal
        # Imported here, so that a bench without them needs no library of theirs.
        if bench.gripper is not None:
            from rig.devices.gripper.robotiq import GripWatch

            self._grip = GripWatch(bench.gripper, clock, self._tell)
        if bench.pedal is not None:
            from rig.devices.hid.pedal import PedalWatch

            self._pedal = PedalWatch(bench.pedal, clock, self._on_pedal)
            if bench.pedal.mode == "dead_man":
                from rig.devices.hid.pedal import DeadMan

                self._dead_man = DeadMan()

    def __enter__(self) -> Sentinels:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def open(self) -> dict[str, dict[str, Any]]:
        """Reach them all and start to watch; their facts by device.

        Raises:
            DeviceLost: One is not there, or the gripper holds nothing.
        """
        facts = {}
        if self._grip is not None:
            facts["gripper"] = self._grip.open(self._timeout)
        if self._pedal is not None:
            facts["pedal"] = self._pedal.open()
        return facts

    def check(self, *, pressing: bool = False) -> None:
        """See whether one of them has something against going on.

        Args:
            pressing: Whether the arm presses, or is about to: a dead-man pedal must be held.

        Raises:
            SafetyStop: The grip is lost.
            DeviceLost: The pedal has been out for too long.
            Released: The dead-man pedal is not held, or was let go of since `armed` said it was.
        """
        with contextlib.suppress(BlockingIOError):
            while self.wake.recv(64):
                pass
        if self._grip is not None and self._grip.lost is not None:
            raise SafetyStop(self._grip.lost)
        self._check_pedal_is_in()
        if pressing and self._dead_man is not None and self._pedal is not None:
            state = self._pedal.state
            if not self._dead_man.held(state):
                done = "released" if state.out_since_ns is None else "unplugged"
                raise Released(f"the foot pedal was {done}")

    def armed(self) -> bool:
        """Whether the arm may press: without a dead-man pedal always, with one once it is pressed.

        The press must come after the last release, and after the last `disarm`.
        """
        dead_man, pedal = self._dead_man, self._pedal
        return dead_man is None or pedal is None or dead_man.armed(pedal.state)

    def disarm(self) -> None:
        """Ask for a fresh press: one that came while the arm was still leaving does not count."""
        if self._dead_man is not None and self._pedal is not None:
            self._dead_man.disarm(self._pedal.state)

    @property
    def wish(self) -> str:
        """What the operator has to do to arm a dead-man pedal, for the live line."""
        if self._pedal is None or self._config is None:
            return ""
        if self._pedal.state.out_since_ns is not None:
            limit = self._config.unplugged_limit
            return f"the foot pedal is unplugged: plug it in (lost after {limit:g} s)"
        if self._pedal.state.down:
            return "let go of the foot pedal, then press and hold it"
        return "press and hold the foot pedal"

    def close(self) -> None:
        """Stop watching; safe twice."""
        for watch in (self._grip, self._pedal):
            if watch is not None:
                watch.close()
        self._waker.close()
        self.wake.close()

    def _check_pedal_is_in(self) -> None:
        if self._pedal is None or self._config is None:
            return
        out = self._pedal.out_for
        if out is not None and out > self._config.unplugged_limit:
            raise DeviceLost(
                f"foot pedal at {self._config.device}: unplugged for {out:.1f} s; allowed: "
                f"{self._config.unplugged_limit:g} s"
            )

    def _on_pedal(self, before: PedalState, after: PedalState) -> None:
        if self._dead_man is None:
            if after.out_since_ns is not None:
                # Whoever trusts to it must not find out when it is needed.
                self._control.pause(PEDAL)
            elif after.presses > before.presses:
                if PEDAL in self._control.paused_by:
                    self._control.resume(PEDAL)
                else:
                    self._control.pause(PEDAL)
        self._tell()

    def _tell(self) -> None:
        with contextlib.suppress(OSError):
            # Full: nobody has looked yet, and one byte is as good as many.
            self._waker.send(b"!")
