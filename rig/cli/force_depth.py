"""`tactile force-depth`: press straight down and up again; print a table and a curve."""

import argparse
from pathlib import Path

from recorder.errors import SessionError
from recorder.session import Session, press_curves, save_curves
from rig.acquire.calibration.store import require_gauge
from rig.acquire.collector import CollectRequest
from rig.cli.options import recording_options
from rig.cli.recording import Recording, record, recording_of
from rig.core.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    recording_options(parser, indenter="prism", gauge=True)


def run(options: argparse.Namespace) -> int:
    """Press, print and draw; return the exit code."""
    return press(recording_of(options))


def press(recording: Recording) -> int:
    """Press along the bench's `force_depth`, print and draw the curve; return the exit code."""
    bench = recording.bench
    if bench.force_depth is None:
        raise ConfigError(
            f"{recording.file.path}.force_depth: missing; allowed: depth_max_mm, repeats "
            "(see docs/how-to/set-up-a-bench.md)"
        )
    require_gauge(bench, "force-depth")
    path = recording.session(bench.indenter, "force-depth")
    request = CollectRequest.of(
        bench,
        path,
        bench.force_depth,
        operator=recording.operator,
        calibration=recording.calibration(),
        go_on=recording.resume(path),
    )
    code = record(recording, request)
    show_curve(path)
    return code


def show_curve(path: Path) -> None:
    """Print the table of a session of presses and write its curve to a PNG."""
    try:
        session = Session(path)
        curves = press_curves(session)
    except SessionError as error:
        print(f"no curve: {error}")
        return
    print("\n".join(curves.lines()))
    picture = path.with_suffix(".curve.png")
    try:
        save_curves(curves, picture, f"{session.attrs['sensor']}, {session.attrs['indenter']}")
    except OSError as error:
        print(f"no curve: {picture}: {error}")
    else:
        print(f"force-depth curve: {picture}")
