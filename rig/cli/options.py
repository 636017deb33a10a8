"""Options shared by several commands, and the objects made from them."""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import select
import socket
import sys
import termios
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.options import add_value, next_command
from recorder.session import Session
from rig.acquire.calibration import store
from rig.acquire.control import Interrupted
from rig.bench.bench import (
    BENCHES_FOLDER,
    NO_GAUGE,
    Bench,
    BenchFile,
    find_bench,
    read_content,
    with_simulated_world,
)
from rig.bench.guards import without_gauge
from rig.bench.indenter import find_indenter
from rig.bench.worlds import Sources
from rig.core.config import from_si
from rig.core.errors import ConfigError
from rig.monitor.access import LOOPBACK_HOST, AccessPolicy, is_loopback

if TYPE_CHECKING:
    from rig.acquire.collector import CollectRequest
    from rig.monitor.collection import CollectionPage


def bench_options(
    parser: argparse.ArgumentParser,
    *,
    mock: bool = True,
    sources: bool = False,
    gauge: bool = False,
    session: bool = False,
) -> argparse._ArgumentGroup:
    """Add --sensor, --bench and those of a mock bench, whose group is returned.

    `mock` adds --world, and --force unless the command needs a `gauge`; `sources` the options for
    real recordings that a mock bench plays; `session` --session, in place of a bench, and several
    of each.
    """
    bench = parser.add_argument_group("bench")
    chosen = bench.add_mutually_exclusive_group()
    action, kind = ("append", str) if session else ("store", Path)
    name = "name of a bench file, searched in benches/lab/, benches/ and the package"
    chosen.add_argument("--sensor", action=action, metavar="NAME", help=name)
    path = "path of a bench file, or its name"
    chosen.add_argument("--bench", type=kind, action=action, metavar="FILE", help=path)
    if session:
        help_ = "read this session in place of a bench"
        chosen.add_argument("--session", action=action, metavar="PATH", help=help_)
    group = parser.add_argument_group("mock bench only")
    if mock:
        group.add_argument(
            "--world",
            choices=("sim",),
            help="solve the contact along the arm's path, in place of superposed presses",
        )
    if mock and not gauge:
        group.add_argument(
            "--force",
            choices=(NO_GAUGE,),
            help="use the bench without its gauge; a lab bench states `force: none` in its file",
        )
    if sources:
        group.add_argument(
            "--camera",
            type=Path,
            metavar="PATH",
            help="play this folder of images or video file in place of the simulated view",
        )
        group.add_argument(
            "--still",
            action="store_true",
            help="declare --camera a still scene: each image is held for seconds",
        )
        group.add_argument(
            "--taxels", type=Path, metavar="FILE", help="play this .npy file of raw counts (T, 48)"
        )
    return group


def benches_option(parser: argparse._ActionsContainer) -> None:
    """Add --benches."""
    add_value(parser, "--benches", "DIR", BENCHES_FOLDER, "folder of bench files", Path)


def recording_options(
    parser: argparse.ArgumentParser,
    *,
    sources: bool = False,
    gauge: bool = False,
    indenter: str = "",
) -> argparse._ArgumentGroup:
    """Add the options of a command that records; return the group of a mock bench's options.

    `indenter` is that of the command; empty: that of the bench file. See `bench_options`.
    """
    group = bench_options(parser, sources=sources, gauge=gauge)
    session = parser.add_argument_group("session")
    session.add_argument(
        "--indenter",
        default=indenter,
        metavar="NAME",
        help=f"name of the indenter on the arm ({indenter or 'default: that of the bench file'})",
    )
    session.add_argument(
        "--out", type=Path, metavar="PATH", help="session to write (default: in sessions/)"
    )
    session.add_argument(
        "--operator", default="", metavar="NAME", help="operator's name (default: the login name)"
    )
    calibration_options(session)
    return group


def bench_path(options: argparse.Namespace) -> Path:
    """Return the bench file of --bench or --sensor, or that of the session to resume."""
    if options.bench is not None:
        path: Path = options.bench
        # A name, or a file of the usual folder: that of the lab, else the packaged one.
        if not path.exists() and path.parent in (Path(), BENCHES_FOLDER):
            return find_bench(path.stem, where="--bench")
        return path
    sensor = options.sensor
    if sensor is None and getattr(options, "resume", None) is not None:
        sensor = Session(options.resume).attrs["sensor"]
    if sensor is None:
        raise ConfigError("--sensor, --bench: both missing; allowed: one of them")
    return find_bench(sensor)


def chosen_bench(options: argparse.Namespace) -> BenchFile:
    """Return the selected bench file, with --world and --force applied."""
    chosen = {name: getattr(options, name, None) for name in ("world", "force", "resume")}
    return bench_file(bench_path(options), **chosen)


def bench_file(
    path: Path, *, world: str | None = None, force: str | None = None, resume: Path | None = None
) -> BenchFile:
    """Read a bench file, as it is used.

    With the world `sim`, the contact of a mock bench is simulated; with the force `none`, it is
    used without its gauge. A resumed session continues in the world in which it began, and without
    a gauge if it began so.
    """
    content = read_content(path)
    began = {} if resume is None else Session(resume).attrs["bench"]
    if world is not None or (began.get("world") or {}).get("tier") == "layer":
        content = with_simulated_world(content, str(path))
    if force is not None or (began.get("force") == NO_GAUGE and content.get("mock")):
        content = without_gauge(content, str(path))
    return BenchFile.of(content, path)


def sources_of(options: argparse.Namespace, file: BenchFile) -> Sources:
    """Return the recordings of --camera, --still and --taxels."""
    path, bench = file.path, file.bench
    for option, recording, device in (
        ("--camera", options.camera, bench.of_kind("camera")),
        ("--taxels", options.taxels, bench.of_kind("taxels")),
    ):
        if recording is None:
            continue
        if not bench.mock:
            raise ConfigError(f"{option}: {path} is a lab bench; allowed: a mock bench")
        if not device:
            kind = "camera" if option == "--camera" else "taxels"
            raise ConfigError(
                f"{option}: found {recording}; {path} has no {kind}: nothing would play it"
            )
    if options.still and options.camera is None:
        raise ConfigError("--still: goes with --camera only")
    motion = "still" if options.still else "moving"
    return Sources(camera=options.camera, camera_motion=motion, taxels=options.taxels)


def banner(file: BenchFile) -> str:
    """Return the first line to print, which states if this is a mock bench or a lab bench."""
    if file.bench.mock:
        return (
            f"MOCK BENCH ({file.path}): every device is an emulator, no arm moves; "
            "time limits are looser than a lab's"
        )
    return f"LAB BENCH ({file.path}): the arm WILL move"


def bench_command(name: str, options: argparse.Namespace, **others: object) -> str:
    """Return the command to continue with on the bench of these options, with others."""
    return next_command(name, **bench_choice(options), **others)


def bench_choice(options: argparse.Namespace) -> dict[str, object]:
    """Return the options that choose a bench."""
    return {key: getattr(options, key, None) for key in ("sensor", "bench", "world", "force")}


def free_path(path: Path) -> Path:
    """Return `path`, or the first of NAME-2.zarr, NAME-3.zarr ... that does not exist."""
    free, number = path, 1
    while free.exists():
        number += 1
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return free


@contextlib.contextmanager
def logged_to(session: Path) -> Iterator[None]:
    """Log messages from level INFO to the terminal and, with times, to a file beside the session.

    Of sessions within a session, each has its own file; that of the outermost has all messages. The
    file is removed if no session was written: all of it was on the terminal.
    """
    path = session.with_suffix(".log")
    terminal = logging.StreamHandler()
    terminal.setFormatter(logging.Formatter("%(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[terminal])
    root = logging.getLogger()
    if any(getattr(one, "baseFilename", None) == os.path.abspath(path) for one in root.handlers):
        yield
        return
    file = logging.FileHandler(path)
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root.addHandler(file)
    try:
        yield
    finally:
        root.removeHandler(file)
        file.close()
        if not session.exists():
            path.unlink(missing_ok=True)


def calibration_options(parser: argparse._ActionsContainer) -> None:
    """Add --calibrations."""
    about = "folder of the results of home and calibrate-latency"
    add_value(parser, "--calibrations", "DIR", store.FOLDER, about, Path)


# The page that a command serves.


def add_page(
    parser: argparse._ActionsContainer, option: str, what: str, default: AccessPolicy | None = None
) -> None:
    """Add an option with the address of a page, whose help is `what` and the address.

    `default` is the address without the option; None: no page is served then.
    """
    address = default or AccessPolicy()
    parser.add_argument(
        option,
        type=page_access,
        nargs="?",
        const=address,
        default=default,
        metavar="ADDRESS",
        help=f"{what}: PORT ({address.port}; 0: any free port) of this machine only, or HOST:PORT; "
        "a host that others can reach requires a token, which is printed",
    )


def page_access(text: str) -> AccessPolicy:
    """Read the address of a page."""
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) <= 0xFFFF):
        raise argparse.ArgumentTypeError(
            f"found {text!r}; allowed: PORT or HOST:PORT, with a whole number from 0 to 65535"
        )
    return AccessPolicy(host.strip("[]") or LOOPBACK_HOST, int(port))


def check_page(option: str, access: AccessPolicy | None) -> None:
    """Check the address of a page before anything is started."""
    if access is None:
        return
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            access.host, access.port, type=socket.SOCK_STREAM
        )[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(
            f"{option}: found {access.host}:{access.port}: {reason}; "
            "allowed: a free port of this machine"
        ) from None


def page_lines(access: AccessPolicy, urls: list[str], power: str) -> list[str]:
    """Return lines with the addresses of a page, and what others may do who have them."""
    lines = [f"watch it at {url}" for url in urls]
    if not is_loopback(access.host):
        lines.append(f"whoever has this address can {power}: the connection is not encrypted")
    return lines


@contextlib.contextmanager
def opened_page(
    access: AccessPolicy, calibrations: Path, bench: Bench, folder: Path, request: CollectRequest
) -> Iterator[CollectionPage]:
    """Run the monitoring page during the context."""
    from rig.monitor.collection import CollectionJob, CollectionPage
    from rig.monitor.lab import Folders

    folders = Folders(request.path.parent, calibrations=calibrations)
    with CollectionPage(access, folders, CollectionJob.of(bench, folder, request)) as page:
        print("\n".join(page_lines(access, page.urls, "see, pause and abort")), flush=True)
        yield page


# Questions on the terminal, and notices of how an arm will move. Only what is typed after a
# question answers it.


def require_terminal() -> None:
    """Reject a bench that will ask before it moves, if there is no terminal to ask on."""
    if not sys.stdin.isatty():
        raise ConfigError("lab bench: no terminal to ask on; allowed: a terminal at the bench")


def answer(question: str, check: Callable[[], None] = lambda: None) -> str | None:
    """Return the line that is typed after the question, without its end; None at the end of input.

    What was typed before is dropped: an Enter meant for an earlier command must not start an arm.
    `check` is called again and again meanwhile, and may raise.
    """
    if sys.stdin.isatty():
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    print(question, end="", flush=True)
    # Ctrl-C may come as soon as the question appears; `input` misses one just before it reads.
    while not select.select([sys.stdin], [], [], 0.2)[0]:
        check()
    line = sys.stdin.readline()
    return line.removesuffix("\n") if line else None


def confirm(lines: list[str], word: str = "move") -> None:
    """Print what will happen, and wait until `word` is typed on this terminal."""
    print("\n".join(lines), flush=True)
    require_terminal()
    try:
        typed = answer(f'type "{word}" and Enter to start, anything else to stop: ')
    except KeyboardInterrupt:
        typed = None
    if typed != word:
        print()
        raise Interrupted(f'the answer was not "{word}"')


def motion_lines(bench: Bench, depth: float) -> list[str]:
    """Return the speeds, the box and the depth of a bench's motion as lines."""
    arm, limits = bench.arm, bench.limits

    def span(low: float, high: float) -> str:
        return f"{from_si(low, 'mm'):g} to {from_si(high, 'mm'):g} mm"

    forces = ", ".join(f"{limits.soft_fraction * force:.3g}" for force in bench.force_rating[:3])
    return [
        f"speed     {from_si(arm.speed, 'mm_s'):g} mm/s near the sensor, "
        f"{from_si(arm.travel_speed, 'mm_s'):g} mm/s above it",
        f"box       x {span(*limits.box_x)}, y {span(*limits.box_y)}, "
        f"z {span(-limits.depth_max, limits.height_max)} of the contact frame",
        f"depth     {from_si(depth, 'mm'):g} mm below the surface; a press ends at {forces} N",
        f"indenter  {find_indenter(bench.indenter).line()}",
    ]
