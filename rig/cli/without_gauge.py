"""Stages before a collection without a gauge: search and touch the surface, press in steps."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from recorder import Session
from recorder.command_line.errors import EXIT_DONE
from rig.acquire import no_gauge
from rig.acquire.calibration import signal_onset, store
from rig.acquire.calibration.calibration import Calibration, FirstPressRecord, HomeCalibration
from rig.acquire.request import CollectRequest, plan_of
from rig.bench.bench import Bench
from rig.bench.no_gauge import check_plan, lines, slowed
from rig.cli.options import confirm, free_path
from rig.cli.recording import StartedBench, record
from rig.core.clock import file_stamp
from trajectories import FirstPress


class StageFailed(Exception):
    """A stage did not complete; `code` is the exit code."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


def home_command(options: argparse.Namespace, bench: Bench) -> str:
    """Return the command that finds the surface of a lab bench."""
    where = f"--bench {options.bench}" if options.bench else f"--sensor {bench.sensor}"
    return f"tactile home {where} --indenter {bench.indenter}"


def find_surface(
    path: Path,
    bench: Bench,
    content: dict[str, Any],
    folder: Path,
    *,
    on: StartedBench | None = None,
    operator: str = "",
) -> HomeCalibration:
    """Search and touch the surface, and return the calibration.

    Args:
        path: The bench file.
        bench: The bench as its file describes it.
        content: Content of the file.
        folder: Folder for the two sessions.
        on: The bench, if it has been started.
        operator: Name of the operator.

    Raises:
        StageFailed: A session was stopped.
        SafetyStop: The surface is not where it may be.
        ConfigError, DeviceLost, SessionError, Interrupted: Before anything was recorded.
    """
    stamp = file_stamp()
    session = _session(folder, bench, "search", stamp)
    plan = no_gauge.search_plan(bench)
    plan_of(CollectRequest(session), no_gauge.searching(bench), plan)
    request = CollectRequest(session, operator=operator, contact_change=no_gauge.CONTACT)
    _done(record(path, content, request, plan, prepared=no_gauge.searching, on=on))
    rough = no_gauge.rough_height(Session(session))
    if abs(rough) > no_gauge.SHIFT_MAX + no_gauge.TOUCH_ABOVE:
        raise no_gauge.shifted(rough)
    session = _session(folder, bench, "home", stamp)
    touches = no_gauge.touch_plan(bench)

    def prepared(ready: Bench) -> Bench:
        return no_gauge.touching(no_gauge.at_surface(ready, rough))

    plan_of(CollectRequest(session), prepared(bench), touches)
    request = CollectRequest(session, operator=operator)
    _done(record(path, content, request, touches, prepared=prepared, on=on))
    found = signal_onset.evaluate(Session(session), touches)
    home = no_gauge.home_of(found, rough, bench, content)
    print("\n".join(no_gauge.lines_of(found, home, no_gauge.true_height(bench))), flush=True)
    no_gauge.check_surface(found, home.shift)
    return home


def press_in_steps(
    path: Path,
    bench: Bench,
    content: dict[str, Any],
    folder: Path,
    calibration: Calibration,
    depth: float,
    *,
    on: StartedBench | None = None,
    operator: str = "",
) -> FirstPressRecord:
    """Press the sensor for the first time, in steps, and return the record of it.

    Args:
        path: The bench file.
        bench: The bench as its file describes it.
        content: Content of the file.
        folder: Folder for the session.
        calibration: The surface.
        depth: Depth of the last press [m].
        on: The bench, if it has been started.
        operator: Name of the operator.

    Raises:
        StageFailed: The session was stopped.
        ConfigError, DeviceLost, SafetyStop, SessionError, Interrupted: Before anything was
            recorded.
    """
    plan = FirstPress(depth)
    session = _session(folder, bench, "first-press", file_stamp())
    steps = no_gauge.Steps(plan, session, None if bench.mock else confirm)
    request = CollectRequest(
        session, operator=operator, calibration=calibration, after_target=steps.after_target
    )

    def prepared(ready: Bench) -> Bench:
        return slowed(calibration.applied(ready), depth)

    _done(record(path, content, request, plan, prepared=prepared, on=on))
    return FirstPressRecord(
        date_utc=store.now_utc(),
        mock=bench.mock,
        tcp=tuple(bench.arm.tcp),
        depth=depth,
        signals=tuple(steps.largest.values()),
    )


def prepare(
    options: argparse.Namespace,
    path: Path,
    bench: Bench,
    content: dict[str, Any],
    calibration: Calibration,
    depth: float,
    folder: Path,
    *,
    on: StartedBench,
) -> Calibration:
    """Run the stages that must precede a collection, and return its calibration.

    A mock bench finds its surface now and asks nothing. A lab bench must have been measured by
    `tactile home`, and asks at every step of the first press.

    Args:
        options: Options of the command.
        path: The bench file.
        bench: The bench as its file describes it.
        content: Content of the file.
        calibration: What is known of the sensor.
        depth: Deepest indentation of the plan [m].
        folder: Folder for the sessions of the stages.
        on: The bench.

    Raises:
        StageFailed: A stage was stopped.
        SafetyStop, ConfigError, DeviceLost, SessionError, Interrupted: Nothing may be pressed.
    """
    if options.resume:
        return calibration
    if bench.mock:
        home = find_surface(path, bench, content, folder, on=on, operator=options.operator)
        calibration = dataclasses.replace(calibration, home=home, file="found in the same run")
    pressed = store.pressed_before(options.calibrations, bench, bench.indenter, depth)
    if bench.mock or not pressed:
        made = press_in_steps(
            path, bench, content, folder, calibration, depth, on=on, operator=options.operator
        )
        if not bench.mock:
            store.store(options.calibrations, bench.sensor, first_press={bench.indenter: made})
    return calibration


def check_before(
    options: argparse.Namespace, bench: Bench, calibration: Calibration, depth: float
) -> None:
    """Reject a collection without a gauge before anything is started, and say what stands in.

    Raises:
        ConfigError: The plan could overload the sensor, or the surface of a lab bench is unknown.
    """
    check_plan(bench, depth)
    print("\n".join(lines(bench, depth)), flush=True)
    if not bench.mock:
        no_gauge.check_home(bench, calibration, home_command(options, bench))


def _session(folder: Path, bench: Bench, what: str, stamp: str) -> Path:
    return free_path(folder / f"{bench.sensor}-{what}-{stamp}.zarr")


def _done(code: int) -> None:
    if code != EXIT_DONE:
        raise StageFailed(code)
