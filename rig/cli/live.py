"""`tactile live`: predict forces with a trained model while the sensor is touched."""

from __future__ import annotations

import argparse
import contextlib
import functools
import math
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from recorder.command_line.options import positive
from recorder.session import Session
from rig.acquire.control import InterruptFlag
from rig.cli.options import add_page, bench_options, check_page, chosen_bench, page_lines
from rig.core.clock import Clock, SystemClock
from rig.core.errors import ConfigError

if TYPE_CHECKING:
    from rig.bench.bench import Bench
    from rig.monitor.forces_page import ForcesJob, ForcesPage
    from rig.monitor.watched import Watched


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
        action="append",
        metavar="MODEL",
        help="folder of a trained force model, its web address, demo, or the name of one that an "
        "installed package offers; for several sensors side by side NAME=MODEL for each, and "
        "--sensor, --bench or --session as NAME=..., or one whose streams have these names",
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
        "gauge's or true forces where there are any; of several sensors to CSV-NAME each",
    )
    add_page(parser, "--page", "serve a page of the last 20 s, and forces for programs (/forces)")


def run(options: argparse.Namespace) -> int:
    """Predict, print and summarise; return the exit code."""
    from rig.monitor.forces import ForceLine
    from rig.monitor.forces_page import ForcesJob
    from rig.monitor.predictor import made_for
    from rig.monitor.side_by_side import SensorJob, SideBySide

    jobs, shown = [], {}
    for name, one in _sensors(options).items():
        _check(one)
        source, made = _source(one), made_for(one.model)
        predictor = {
            "model": one.model,
            "sensor": source.sensor,
            "signal": source.signal,
            "description": source.description,
            "depth": source.depth,
            "before": one.before,
            "runtime": one.runtime,
            "preset_name": one.preset,
        }
        jobs.append(SensorJob(name, source.open, predictor, options.seconds, one.out))
        shown[name] = ForcesJob(source.sensor, source.kind, made, name=name)
        text = f"{source.kind} ({source.name}): no arm moves; model {made}"
        print(named(name, text), flush=True)

    def warn(name: str, text: str) -> None:
        shown[name] = replace(shown[name], warnings=(*shown[name].warnings, text))
        print(f"WARNING: {named(name, text)}", file=sys.stderr, flush=True)

    with contextlib.ExitStack() as stack:
        stop = stack.enter_context(InterruptFlag())
        line, stopping = ForceLine(SystemClock(), sys.stdout), False
        sensors = stack.enter_context(SideBySide(jobs, warn))
        page = _opened_page(options, list(shown.values()), stack)
        sensors.begin()
        while not sensors.over:
            if stop.requested and not stopping:
                sensors.stop()
                stopping = True
            for name, reading, t_ns, latency, gauge in sensors.news(0.1):
                line(reading, latency, name)
                if page is not None:
                    page.add(reading, t_ns, latency, gauge, name)
        line.close()
        for name, end in sensors.ends.items():
            print("\n".join(named(name, text) for text in end.lines), flush=True)
            if page is not None:
                page.finish(end.true, name)
    lost = {name: end.lost for name, end in sensors.ends.items() if end.lost}
    for name, text in lost.items():
        print(f"device lost: {named(name, text)}", file=sys.stderr)
    return EXIT_DEVICE_LOST if lost else EXIT_DONE


# Options that each of several sensors has.
_OWN = ("model", "sensor", "bench", "session")


def _sensors(options: argparse.Namespace) -> dict[str, argparse.Namespace]:
    """Return the options of each sensor, by its name; that of a single one may be empty."""
    given = {key: _by_name(key, getattr(options, key) or []) for key in _OWN}
    names = given["model"]
    sensors = {name: argparse.Namespace(**vars(options), stream="") for name in names}
    for key, values in given.items():
        if values and "" not in values and set(values) != set(names):
            raise ConfigError(
                f"--{key}: found {', '.join(values)}=...; allowed: the names of --model "
                f"({', '.join(names) or 'it has none'})"
            )
        for name, one in sensors.items():
            value = values.get(name, values.get(""))
            path = key in ("bench", "session") and value is not None
            setattr(one, key, Path(value or "") if path else value)
            one.stream = name if "" in values else one.stream
            if name and options.out is not None:
                one.out = options.out.with_stem(f"{options.out.stem}-{name}")
    return sensors


def _by_name(option: str, values: list[str]) -> dict[str, str]:
    """Return values by their names NAME=VALUE; the name of a single one may be missing."""
    by_name: dict[str, str] = {}
    for value in values:
        name, sign, text = value.partition("=")
        name, text = (name, text) if sign and name.isidentifier() else ("", value)
        if name in by_name or (len(values) > 1 and not name):
            raise ConfigError(f"--{option}: found {value}; allowed: NAME={text}, each name once")
        by_name[name] = text
    return by_name


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
    """Opens it, with a folder for the files of a mock bench; it can be sent to a process."""
    signal: str
    """Kind of the stream that is read."""
    description: str = ""
    depth: float = math.nan
    """Depth of the deepest press that is planned [m]; NaN: unknown."""


def _source(options: argparse.Namespace) -> _Source:
    from rig.monitor import watched

    session, stream = options.session, options.stream
    file = None if session is not None else chosen_bench(options)
    if file is not None and file.bench.mock:
        if stream:
            raise ConfigError(
                f"{file.path}: a mock bench, which presses one sensor; allowed beside others: "
                f"--sensor {stream}=..., a bench each"
            )
        file = file.with_indenter(options.indenter or "")
        mock = functools.partial(watched.mock_bench, file, rate_hz=options.rate_hz)
        return _Source(file.bench.sensor, "MOCK BENCH", file.path, mock, *_presses(file.bench))
    name = session if file is None else file.path
    for option in ("world", "force", "rate_hz", "indenter"):
        if getattr(options, option) is not None:
            raise ConfigError(f"--{option.replace('_', '-')}: {name} is no mock bench")
    if file is None:
        recorded = Session(session)
        signal = watched.signal_of(recorded, stream)
        depth = float(np.max(recorded.targets.get("depth", np.nan), initial=-np.inf))
        return _Source(
            watched.sensor_of(recorded, signal),
            "REPLAY",
            name,
            functools.partial(_replayed, session, stream),
            recorded.streams[signal].traits.kind,
            depth=depth,
        )
    open_lab = functools.partial(_opened_lab, file.bench, stream)
    signal, description, depth = _presses(file.bench)
    signal = file.bench.row(stream).kind if stream else signal
    return _Source(file.bench.sensor, "LAB BENCH", name, open_lab, signal, description, depth)


def _replayed(session: Path, stream: str, _: Path, clock: Clock) -> AbstractContextManager[Watched]:
    from rig.monitor.watched import replayed

    return replayed(session, clock, stream)


def _opened_lab(
    bench: Bench, stream: str, _: Path, clock: Clock
) -> AbstractContextManager[Watched]:
    from rig.monitor.watched import lab_bench

    return lab_bench(bench, clock, stream, say=functools.partial(print, flush=True))


def _presses(bench: Bench) -> tuple[str, str, float]:
    """Return the kind of a bench's signal, its description, and its deepest press [m]."""
    depth = max(target.depth for target in bench.trajectory.targets())
    return "" if bench.signal is None else bench.signal.kind, bench.description, depth


def named(name: str, text: str) -> str:
    """Return a text about a sensor, after its name."""
    return f"{name}: {text}" if name else text


def _opened_page(
    options: argparse.Namespace, jobs: list[ForcesJob], stack: contextlib.ExitStack
) -> ForcesPage | None:
    """Serve the page of --page until the end of the stack, and print its address."""
    if options.page is None:
        return None
    from rig.monitor.forces_page import ForcesPage
    from rig.monitor.lab import Folders

    page = stack.enter_context(ForcesPage(options.page, Folders(Path("sessions")), jobs))
    print("\n".join(page_lines(options.page, page.urls, "see the forces")), flush=True)
    return page
