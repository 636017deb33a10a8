"""Process of the World: reads the arm's motion and publishes timestamped states.

    python -m rig.mock.emulate world --file world.json

Contact depends on its history, so exactly one process steps the World, in the order of the arm's
cycles; the sensors' emulators only serve the published states.
"""

from typing import Any

import numpy as np

from rig.bench.worlds import Lab
from rig.core.clock import Clock, SystemClock
from rig.core.emulation import Emulator, Served
from rig.core.mock_names import ARM_FILE, WORLD_FILE
from rig.core.samples import ARM_TRUTH, WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.mock.world import WorldConfig, build_world
from rig.mock.world.contact import World
from rig.mock.world.lab import Gauge
from rig.mock.world.truth import TruthLog

# The arm's cycle is 2 ms: after most of it, polling delays the sensors by at most 0.4 ms.
_REST_NS, _POLL_NS = 1_400_000, 400_000


class WorldHost(Emulator):
    """Steps a World along an arm's published motion, in its own thread."""

    def __init__(
        self,
        world: World,
        arm: SharedLatest,
        states: SharedLatest,
        truth: TruthLog | None,
        lab: Lab | None = None,
    ) -> None:
        super().__init__()
        self._gauge = Gauge(lab or Lab())
        self._hand = np.zeros(3)
        self._mount = np.eye(3)
        self._world = world
        self._arm = arm
        self._states = states
        self._truth = truth

    def start(self) -> None:
        """Follow the arm from now on."""
        self._run_threads(self._run)

    def apply(self, fault: str, **values: Any) -> dict[str, Any]:
        """Lay a weight on the sensor, or mount its gauge otherwise; see `FaultPort`.

        hand  force    (3,) [N], added to that of the contact
        mount  matrix  (3, 3), from a true force or torque to the one that the gauge shows
        """
        if fault == "hand":
            self._hand = np.reshape(values["force"], 3)
        elif fault == "mount":
            self._mount = np.reshape(values["matrix"], (3, 3))
        elif fault != "state":
            raise ValueError(f"fault: found {fault!r}; known: hand, mount, state")
        return {"force": self._hand.tolist(), "matrix": self._mount.tolist()}

    def _state(self, t_ns: int, pose: np.ndarray) -> np.void:
        state = self._world.step(t_ns, pose)
        state["wrench"][:3] += self._hand
        state["wrench"] = (state["wrench"].reshape(2, 3) @ self._mount.T).ravel()
        return state

    def _release(self) -> None:
        if self._truth is not None:
            self._truth.close()

    def _run(self) -> None:
        clock = SystemClock()
        last_count = self._arm.count
        while not self._ending.is_set():
            count = self._arm.count
            if count == last_count:
                clock.sleep_until(clock.now_ns() + _POLL_NS)
                continue
            seen_ns, record = clock.now_ns(), self._arm.read()
            self.missed += max(count - last_count - 1, 0)
            last_count = count
            if record is None:
                continue
            state = self._state(int(record["t_ns"]), record["pose"])
            if self._truth is not None:
                self._truth.append(state)
            state["wrench"] = self._gauge.measured(state)
            self._states.write(state)
            clock.sleep_until(seen_ns + _REST_NS)


def emulate(settings: WorldConfig, _: Clock) -> Served:
    """Return the host of the World."""
    folder = settings.folder
    host = WorldHost(
        build_world(settings),
        SharedLatest.attach(folder / ARM_FILE, ARM_TRUTH),
        SharedLatest.attach(folder / WORLD_FILE, WORLD_STATE, writable=True),
        TruthLog(settings.truth) if settings.truth else None,
        settings.world.lab,
    )
    return Served("world", host, host.apply)
