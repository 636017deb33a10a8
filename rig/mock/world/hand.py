"""Process of the World of a hand: follows its opening and publishes the state of each finger.

python -m rig.mock.emulate hand --file world.json
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rig.bench.pair import FINGERS, GraspObject, PairSpec
from rig.core.clock import Clock, SystemClock
from rig.core.emulation import NO_CONTACT_DEPTH, Emulator, Served, require_loopback
from rig.core.mock_names import HAND_FILE
from rig.core.samples import HAND_TRUTH, WORLD_STATE
from rig.core.shared_memory import SharedLatest
from rig.mock.world.pair import PairState, PairWorld
from rig.mock.world.truth import TruthLog

_POLL_NS = 500_000


@dataclass(frozen=True, slots=True)
class HandWorldConfig:
    """Settings of the World of a hand."""

    pair: PairSpec
    objects: tuple[GraspObject, ...]
    folder: Path
    """Run folder with the shared records."""
    truth: Path | None = None
    """Folder to log every state to, in `left` and `right`; None: none."""
    host: str = "127.0.0.1"
    fault_port: int | None = None
    """Port for the hands of an operator; None: none."""

    def __post_init__(self) -> None:
        require_loopback(self.host)


class HandHost(Emulator):
    """Steps a PairWorld along the published opening of a hand, in its own thread."""

    def __init__(self, settings: HandWorldConfig) -> None:
        super().__init__()
        self._world, self._objects = PairWorld(settings.pair), settings.objects
        for each in (*settings.objects, None):
            self._world.place(each)
        self._number, self._down, self._lifted = 0, (0.0, 0.0, 1.0), False
        self._orders: list[int | None] = []
        folder, truth = settings.folder, settings.truth
        self._hand = SharedLatest.attach(folder / HAND_FILE, HAND_TRUTH)
        self._states = [
            SharedLatest.attach(folder / f"{name}.state", WORLD_STATE, writable=True)
            for name in FINGERS
        ]
        if truth is not None:
            truth.mkdir(parents=True, exist_ok=True)
        self._truth = [] if truth is None else [TruthLog(truth / name) for name in FINGERS]

    def start(self) -> None:
        """Follow the hand from now on."""
        self._run_threads(self._run)

    def apply(self, fault: str, **values: Any) -> dict[str, Any]:
        """Act as the operator's hands, as `rig.acquire.squeeze.Hands` says; see `FaultPort`."""
        if fault == "place":
            self._orders.append(values["number"])
        elif fault == "turn":
            self._down = tuple(np.reshape(values["down"], 3).tolist())
        elif fault == "carry":
            self._lifted = bool(values["lifted"])
        else:
            raise ValueError(f"fault: found {fault!r}; known: place, turn, carry")
        return {}

    def _release(self) -> None:
        for log in self._truth:
            log.close()

    def _run(self) -> None:
        clock, count = SystemClock(), self._hand.count
        while not self._ending.is_set():
            record = self._hand.read()
            if record is None or (newest := self._hand.count) == count:
                clock.sleep_until(clock.now_ns() + _POLL_NS)
                continue
            self.missed += max(newest - count - 1, 0)
            count = newest
            while self._orders:
                number = self._orders.pop(0)
                self._number = number or 0
                self._world.place(None if number is None else self._objects[number])
            opening, t_ns = float(record["opening"]), int(record["t_ns"])
            self._publish(self._world.step(t_ns, opening, self._down, self._lifted))

    def _publish(self, pair: PairState) -> None:
        for side, states in enumerate(self._states):
            state: np.void = np.zeros(1, WORLD_STATE)[0]
            state["t_ns"], state["object"] = pair.t_ns, self._number
            state["depth"] = NO_CONTACT_DEPTH
            if np.isfinite(pair.depth[side]):
                state["depth"], state["contact"] = pair.depth[side], pair.tip[side, :2]
            state["shear"], state["wrench"] = pair.shear[side], pair.wrench[side]
            states.write(state)
            if self._truth:
                self._truth[side].append(state)


def emulate(settings: HandWorldConfig, _: Clock) -> Served:
    """Return the host of the World of a hand."""
    host = HandHost(settings)
    return Served("world", host, host.apply)
