"""`tactile live`: predict forces with a trained model while the sensor is touched."""

from __future__ import annotations

import argparse
import contextlib
import functools
import math
import sys
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from recorder.command_line.options import positive
from recorder.session import Session
from rig.acquire.control import InterruptFlag
from rig.cli.options import add_page, bench_options, check_page, chosen_bench, page_lines
from rig.core.clock import Clock, SystemClock
from rig.core.errors import ConfigError, DeviceLost

if TYPE_CHECKING:
    from rig.bench.bench import Bench
    from rig.monitor.forces_page import ForcesPage
    from rig.monitor.predictor import LiveForce
    from rig.monitor.watched import Triple, Watched


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    mock = bench_options(parser, session=True)
    mock.add_argument(
        "--rate-hz", type=positive, help="frames per second (default: the bench file's)"
    )
    mock.add_argument(
        "--indenter",
        metavar="NAME",
        help="indenter of the emulated finger (default: the bench file's)",
    )
    parser.description = (
        "Read the sensor, print Fx, Fy, Fz for every frame, and finally the latency. "
        "No arm moves; on a mock bench an emulated finger presses along its trajectory. "
        "Start with the sensor without contact: its first frames are the reference."
    )
    parser.add_argument(
        "--model",
        required=True,
        metavar="MODEL",
        help="folder of a trained force model, its web address, demo, or the name of one that an "
        "installed package offers",
    )
    parser.add_argument(
        "--before",
        metavar="MODEL",
        help="show forces of this model beside, such as the source's before a transfer",
    )
    parser.add_argument("--seconds", type=positive, help="duration [s] (default: until Ctrl-C)")
    parser.add_argument(
        "--runtime",
        choices=("auto", "onnx", "openvino", "openvino-bf16", "torch"),
        default="auto",
        help="runtime of the model (%(default)s: onnx if its folder has one, which openvino needs "
        "too, else torch; openvino-bf16 is the fastest on CPUs that support it)",
    )
    parser.add_argument(
        "--preset", metavar="NAME", help="marker detection preset (default: that of the sensor)"
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="CSV",
        help="write every force to this new file, with intervals, those of --before and the "
        "gauge's or true forces where there are any",
    )
    add_page(parser, "--page", "serve a page of the last 20 s")


def run(options: argparse.Namespace) -> int:
    """Predict, print and summarise; return the exit code."""
    from rig.monitor.forces import ForceLine, Summary, add_gauge, watch
    from rig.monitor.predictor import made_for, open_predictor

    _check(options)
    clock = SystemClock()
    lost: DeviceLost | None = None
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-")))
        stop = stack.enter_context(InterruptFlag())
        source = _source(options)
        made, warnings = made_for(options.model), list[str]()

        def warn(text: str) -> None:
            warnings.append(text)
            print(f"WARNING: {text}", file=sys.stderr, flush=True)

        # Load the model first: an emulator would be late if it had to wait for it.
        predictor = open_predictor(
            options.model,
            sensor=source.sensor,
            signal=source.signal,
            description=source.description,
            depth=source.depth,
            before=options.before,
            runtime=options.runtime,
            preset_name=options.preset,
            warn=warn,
        )
        page = _opened_page(options, source, stack, made, warnings)
        print(f"{source.kind} ({source.name}): no arm moves; model {made}", flush=True)
        watched = stack.enter_context(source.open(folder, clock))
        line = ForceLine(clock, sys.stdout)
        summary = Summary()

        def show(reading: LiveForce, t_ns: int, latency: float, gauge: Triple | None) -> None:
            line(reading, latency)
            if page is not None:
                page.add(reading, t_ns, latency, gauge)

        try:
            watch(
                watched,
                predictor,
                clock,
                summary=summary,
                show=show,
                is_over=lambda: stop.requested,
                seconds=options.seconds,
                out=options.out,
            )
        except DeviceLost as error:
            lost = error
        finally:
            line.close()
        wrench = None
        if watched.wrench is not None and summary.frames:
            wrench = watched.wrench(np.array(summary.shows_ns, np.int64))
        print("\n".join(summary.lines(wrench)), flush=True)
        if page is not None:
            page.finish(watched.wrench)
        if options.out is not None:
            if wrench is not None and np.isfinite(wrench[:, :3]).any():
                add_gauge(options.out, wrench)
            print(f"{options.out}: {summary.frames:,} forces")
    if lost is not None:
        print(f"device lost: {lost}", file=sys.stderr)
        return EXIT_DEVICE_LOST
    return EXIT_DONE


def _check(options: argparse.Namespace) -> None:
    """Reject options before any library is loaded, or a device opened; find the models."""
    from rig.monitor.predictor import force_model

    options.model = force_model(options.model)
    if options.before is not None:
        options.before = force_model(options.before)
    check_page("--page", options.page)
    if options.out is not None and options.out.exists():
        raise ConfigError(f"{options.out}: exists; allowed: a new file")


class _Source(NamedTuple):
    sensor: str
    kind: str
    name: Path
    """The session, or the bench file."""
    open: Callable[[Path, Clock], AbstractContextManager[Watched]]
    """Opens it, with a folder for the files of a mock bench."""
    signal: str
    """Kind of the stream that is read."""
    description: str = ""
    depth: float = math.nan
    """Depth of the deepest press that is planned [m]; NaN: unknown."""


def _source(options: argparse.Namespace) -> _Source:
    from rig.monitor import watched

    session = options.session
    file = None if session is not None else chosen_bench(options)
    if file is not None and file.bench.mock:
        file = file.with_indenter(options.indenter or "")
        mock = functools.partial(watched.mock_bench, file, rate_hz=options.rate_hz)
        return _Source(file.bench.sensor, "MOCK BENCH", file.path, mock, *_presses(file.bench))
    name = session if file is None else file.path
    for option in ("world", "force", "rate_hz", "indenter"):
        if getattr(options, option) is not None:
            raise ConfigError(f"--{option.replace('_', '-')}: {name} is no mock bench")
    if file is None:
        recorded = Session(session)
        sensor, stream = str(recorded.attrs.get("sensor", "")), recorded.signal
        signal = recorded.streams[stream].traits.kind if stream else ""
        depth = float(np.max(recorded.targets.get("depth", np.nan), initial=-np.inf))
        replayed = functools.partial(watched.replayed, session)
        return _Source(
            sensor, "REPLAY", name, lambda _, clock: replayed(clock), signal, depth=depth
        )
    bench, say = file.bench, functools.partial(print, flush=True)
    open_lab = functools.partial(watched.lab_bench, bench, say=say)
    return _Source(
        bench.sensor, "LAB BENCH", name, lambda _, clock: open_lab(clock), *_presses(bench)
    )


def _presses(bench: Bench) -> tuple[str, str, float]:
    """Return the kind of a bench's signal, its description, and its deepest press [m]."""
    depth = max(target.depth for target in bench.trajectory.targets())
    return "" if bench.signal is None else bench.signal.kind, bench.description, depth


def _opened_page(
    options: argparse.Namespace,
    source: _Source,
    stack: contextlib.ExitStack,
    made: str,
    warnings: list[str],
) -> ForcesPage | None:
    """Serve the page of --page until the end of the stack, and print its address."""
    if options.page is None:
        return None
    from rig.monitor.forces_page import ForcesJob, ForcesPage
    from rig.monitor.lab import Folders

    job = ForcesJob(source.sensor, source.kind, made, tuple(warnings))
    page = stack.enter_context(ForcesPage(options.page, Folders(Path("sessions")), job))
    print("\n".join(page_lines(options.page, page.urls, "see the forces")), flush=True)
    return page
