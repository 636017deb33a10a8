"""Process that solves the contact of a simulated World along the arm's path.

    python -m rig.mock.emulate solver --file world.json

It reads the arm's newest pose, moves the simulated press there from the previous pose, publishes
the solution, and waits for its next turn. Poses that arrive while it is busy are skipped: the path
between two solutions is a straight line, and there is no queue.
"""

from __future__ import annotations

import logging
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from recorder.command_line.errors import EXIT_DEVICE_LOST
from rig.bench.worlds import WorldSpec
from rig.core.clock import SECOND_NS, Clock, Pacer
from rig.core.emulation import Emulator, Served
from rig.core.mock_names import ARM_FILE, PRESS_FILE, SURFACE_FILE
from rig.core.realtime import SOLVER_PRIORITY
from rig.core.samples import ARM_TRUTH, press_state, surface_state
from rig.core.shared_memory import SharedLatest
from rig.mock.world import WorldConfig
from rig.mock.world.contact import ContactFrame
from rig.mock.world.sensors import dome_of, live_sensor, note_on, row_of

if TYPE_CHECKING:
    from rig.mock.world.sensors import LiveSensor

logger = logging.getLogger(__name__)


class Shared:
    """Records in the run folder to which the solver publishes."""

    def __init__(self, folder: Path, live: LiveSensor) -> None:
        self._live = live
        solved = press_state(len(live.answer.values))
        self._presses = SharedLatest.create(folder / PRESS_FILE, solved)
        shape = live.press.grid.shape
        self._surfaces = SharedLatest.create(folder / SURFACE_FILE, surface_state(shape))
        self._press: np.void = np.zeros(1, solved)[0]
        effects = live.press.scene.effects
        self._press["friction"] = effects.friction.coefficient if effects.friction else 0.0
        self._surface: np.void = np.zeros(1, surface_state(shape))[0]

    def publish(self, t_ns: int) -> None:
        """Publish the sensor's newest solution, for a pose of `t_ns`."""
        answer, press, surface = self._live.answer, self._press, self._surface
        surface["t_ns"] = press["t_ns"] = t_ns
        surface["tip_before"], surface["surface_before"] = surface["tip"], surface["surface"]
        surface["tip"] = press["tip"] = answer.tip
        surface["surface"] = self._live.press.field.displacement[0]
        press["shear"] = self._live.press.shear
        press["touching"] = answer.touching
        for name in ("values", "slope", "rate"):
            press[name] = getattr(answer, name)
        # The deformation first: a reader of the press may need it.
        self._surfaces.write(surface)
        self._presses.write(press)

    def close(self) -> None:
        """Release the files; may be called twice."""
        self._presses.close()
        self._surfaces.close()


class Solver(Emulator):
    """Moves a live sensor along the arm's path, in its own thread."""

    def __init__(
        self,
        live: LiveSensor,
        frame: ContactFrame,
        arm: SharedLatest,
        shared: Shared,
        spec: WorldSpec,
        clock: Clock,
    ) -> None:
        super().__init__()
        self._live, self._frame, self._arm, self._shared = live, frame, arm, shared
        self._pacer = Pacer(clock, spec.solver.rate_hz)
        self._clock = clock
        self._behind_ns = round(spec.solver.behind * SECOND_NS)
        self._before_ns: int | None = None
        self.failed: Exception | None = None
        """Error that ended the solver, if any."""
        self.solved = 0
        """Number of solutions."""
        self.busy_ns = 0
        """Total time spent solving."""
        self.longest_ns = 0
        """Longest time between two solutions in contact."""
        self._began_ns = 0

    def start(self) -> None:
        """Publish the sensor without contact and follow the arm from now on."""
        self._shared.publish(self._clock.now_ns())
        self._began_ns = self._clock.now_ns()
        self._run_threads(self._run)

    def __str__(self) -> str:
        seconds = max(self._clock.now_ns() - self._began_ns, 1) / SECOND_NS
        busy = self.busy_ns / SECOND_NS
        mean = 1e3 * busy / self.solved if self.solved else 0.0
        return (
            f"{self.solved} solutions in {seconds:.0f} s, {mean:.1f} ms each, "
            f"{self.missed} turns missed, {1e-6 * self.longest_ns:.0f} ms at most between two in "
            "contact"
        )

    def turn(self) -> None:
        """Solve once, for the arm's newest pose."""
        record = self._arm.read()
        if record is None or int(record["t_ns"]) == self._before_ns:
            return
        t_ns = int(record["t_ns"])
        began_ns = self._clock.now_ns()
        passed_ns = 0 if self._before_ns is None else t_ns - self._before_ns
        touched = self._live.answer.touching
        self._live.move(self._frame.tip(record["pose"]), passed_ns / SECOND_NS)
        if touched and self._live.answer.touching:
            self.longest_ns = max(self.longest_ns, passed_ns)
            if passed_ns > self._behind_ns:
                raise TimeoutError(
                    f"{1e-6 * passed_ns:.0f} ms between two solutions in contact; allowed: "
                    f"{1e-6 * self._behind_ns:.0f} ms (world.solver.behind_ms); the machine is "
                    "too slow or too busy for this grid"
                )
        self._before_ns = t_ns
        self._shared.publish(t_ns)
        self.solved += 1
        self.busy_ns += self._clock.now_ns() - began_ns

    def _run(self) -> None:
        try:
            while not self._ending.is_set():
                self._pacer.wait()
                self.missed = self._pacer.missed
                self.turn()
        except Exception as error:  # After any error the bench must not continue without a World.
            self.failed = error
            logger.exception("the contact was lost")
            signal.raise_signal(signal.SIGTERM)


def emulate(settings: WorldConfig, clock: Clock) -> Served:
    """Return the solver."""
    spec = settings.world
    live, note = live_sensor(spec, settings.indenter), note_on(spec)
    shared = Shared(settings.folder, live)
    arm = SharedLatest.attach(settings.folder / ARM_FILE, ARM_TRUTH)
    frame = ContactFrame(settings.contact_frame, dome_of(row_of(spec), spec.tier))
    solver = Solver(live, frame, arm, shared, spec, clock)

    def conclude() -> int:
        shared.close()
        arm.close()
        print(f"solver: {solver}{note}", file=sys.stderr, flush=True)
        if solver.failed is None:
            return 0
        print(f"solver: {solver.failed}", file=sys.stderr, flush=True)
        return EXIT_DEVICE_LOST

    return Served("solver", solver, priority=SOLVER_PRIORITY, conclude=conclude)
