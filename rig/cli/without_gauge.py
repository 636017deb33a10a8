"""Stages before a collection without a gauge: search and touch the surface, press in steps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from recorder import Session
from recorder.command_line.errors import EXIT_DONE
from rig.acquire import no_gauge
from rig.acquire.calibration import store
from rig.acquire.calibration.calibration import Calibration
from rig.acquire.no_gauge import StageStopped
from rig.acquire.request import CollectRequest
from rig.acquire.streams import Streams
from rig.bench.bench import Bench
from rig.bench.no_gauge import check_plan, lines, slowed
from rig.cli.options import free_path
from rig.cli.recording import Recording, record
from rig.cli.terminal import confirm
from rig.core.clock import file_stamp
from rig.core.errors import ConfigError
from trajectories import Plan, Target


@dataclasses.dataclass(frozen=True, slots=True)
class StageRecorder:
    """Records the stages of one bench; a `rig.acquire.no_gauge.Record`."""

    recording: Recording
    """The bench, started."""
    folder: Path
    """Folder for the sessions."""

    def __call__(
        self,
        what: str,
        plan: Plan,
        prepared: Callable[[Bench], Bench],
        *,
        contact_change: float = math.inf,
        after_target: Callable[[Target, Session], None] | None = None,
    ) -> Session:
        """Press `plan` and return the session; see `rig.acquire.no_gauge.Record`."""
        path = free_path(self.folder / f"{self.recording.bench.sensor}-{what}-{file_stamp()}.zarr")

        def after(target: Target, streams: Streams) -> None:
            if after_target is not None:
                after_target(target, Session(path))

        request = CollectRequest.of(
            self.recording.bench,
            path,
            plan,
            operator=self.recording.operator,
            calibration=self.recording.uncalibrated(),
            contact_change=contact_change,
            after_target=None if after_target is None else after,
        )
        prepared(self.recording.bench).check_limits(plan)
        code = record(self.recording, request, prepare=prepared)
        if code != EXIT_DONE:
            raise StageStopped(code)
        return Session(path)


def check_before(recording: Recording, calibration: Calibration, depth: float) -> None:
    """Reject a collection without a gauge before anything is started, and print what stands in."""
    bench = recording.bench
    check_plan(bench, depth)
    print("\n".join(lines(bench, depth)), flush=True)
    if not bench.mock:
        hint = recording.next("home", indenter=bench.indenter)
        no_gauge.check_home(bench, calibration, hint)


def prepare(
    recording: Recording, folder: Path, calibration: Calibration, depth: float
) -> Calibration:
    """Run the stages that must precede a collection, and return its calibration.

    A lab bench was measured by `tactile home`, and asks at every step of the first press. A mock
    bench asks nothing, and finds its surface now unless `tactile home` or `tactile setup` has found
    that of the same bench file and indenter as lately as a lab's must be.

    Args:
        recording: The bench, started.
        folder: Folder for the sessions of the stages.
        calibration: Earlier calibration of the sensor.
        depth: Deepest indentation of the plan [m].
    """
    bench, content = recording.bench, recording.file.content
    stages = StageRecorder(recording, folder)
    if bench.mock and not _is_found(bench, calibration, content):
        home = no_gauge.find_surface(bench, content, stages)
        calibration = dataclasses.replace(calibration, home=home, file="found in the same run")
        no_gauge.press_in_steps(bench, calibration, depth, stages, _show)
    elif not store.pressed_before(recording.calibrations, bench, bench.indenter, depth):
        ask = _show if bench.mock else confirm
        made = no_gauge.press_in_steps(bench, calibration, depth, stages, ask)
        store.store(recording.calibrations, bench.sensor, first_press={bench.indenter: made})
    return calibration


def prepared(calibration: Calibration, depth: float, bench: Bench) -> Bench:
    """Return the bench as it presses `depth` [m] without a gauge."""
    return slowed(calibration.applied(bench), depth)


def _is_found(bench: Bench, calibration: Calibration, content: dict[str, Any]) -> bool:
    """Return True if the surface of this very mock bench was found lately and well enough."""
    if calibration.home is None or calibration.home.bench_sha256 != store.bench_hash(content):
        return False
    try:
        no_gauge.check_home(bench, calibration, "")
    except ConfigError:
        return False
    return True


def _show(texts: list[str]) -> None:
    print("\n".join(texts), flush=True)
