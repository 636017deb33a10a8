"""Process of the World: reads the arm's motion and publishes timestamped states.

    python -m rig.mock.world.host --spec world.json --arm arm.state --world world.state

Contact depends on its history, so exactly one process steps the World, in the order of the arm's
cycles; the sensors' emulators only serve the published states.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from rig.core.clock import SystemClock
from rig.core.emulation import Served, SharedWorld, emulator_parser, run_emulator
from rig.core.errors import ConfigError
from rig.core.samples import ARM_TRUTH, WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.mock.world import build_world
from rig.mock.world.analytic import World
from rig.mock.world.truth import TruthLog

# The arm's cycle is 2 ms: polling five times per cycle delays the sensors by at most 0.4 ms.
_POLL_NS = 400_000


class WorldHost:
    """Steps a World along an arm's published motion, in its own thread.

    Args:
        world: The World.
        arm: ARM_TRUTH record to follow.
        states: WORLD_STATE record to publish to.
        truth: Log of every state, closed with the host; or None.
    """

    def __init__(
        self, world: World, arm: SharedLatest, states: SharedLatest, truth: TruthLog | None
    ) -> None:
        self._world = world
        self._arm = arm
        self._states = states
        self._truth = truth
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name="world")
        self.missed = 0
        """Cycles of the arm that ended before they were read."""

    @property
    def address(self) -> str:
        """Text in place of an address: the host is reached through shared memory."""
        return "shared memory"

    def start(self) -> None:
        """Follow the arm from now on."""
        self._thread.start()

    def close(self) -> None:
        """Stop; may be called twice."""
        self._ending.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._truth is not None:
            self._truth.close()

    def _run(self) -> None:
        clock = SystemClock()
        seen = self._arm.count
        while not self._ending.is_set():
            count = self._arm.count
            if count == seen:
                clock.sleep_until(clock.now_ns() + _POLL_NS)
                continue
            record = self._arm.read()
            self.missed += max(count - seen - 1, 0)
            seen = count
            if record is None:
                continue
            state = self._world.step(int(record["t_ns"]), record["pose"])
            self._states.write(state)
            if self._truth is not None:
                self._truth.append(state)


def main(argv: Sequence[str] | None = None) -> int:
    """Run until stopped."""
    parser = emulator_parser("python -m rig.mock.world.host", __doc__)
    parser.add_argument("--spec", type=Path, required=True, help="JSON with world, contact_frame")
    parser.add_argument("--arm", type=Path, required=True, help="the arm emulator's pose")
    parser.add_argument("--truth", type=Path, help="log every state here, for tests")
    return run_emulator(parser, _make, argv)


def _make(args: argparse.Namespace, _: SharedWorld) -> Served:
    if args.world is None:
        raise ConfigError("--world: missing; allowed: the file to publish states to")
    host = WorldHost(
        build_world(args.spec),
        SharedLatest.attach(args.arm, ARM_TRUTH),
        SharedLatest.attach(args.world, WORLD_STATE, writable=True),
        TruthLog(args.truth) if args.truth else None,
    )
    return Served("world", host)


if __name__ == "__main__":
    sys.exit(main())
