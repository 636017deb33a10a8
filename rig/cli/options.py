"""Options shared by several commands, and the objects made from them."""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from recorder import Session
from recorder.command_line.options import next_command
from rig.acquire.calibration import store
from rig.acquire.calibration.calibration import Calibration
from rig.acquire.motion_notice import motion_lines
from rig.bench.bench import Bench, BenchFile, find_bench, read_content, with_simulated_world
from rig.bench.indenter import indenter_names
from rig.bench.no_gauge import NO_GAUGE, without_gauge
from rig.bench.worlds import SimulatedSpec
from rig.cli.terminal import confirm
from rig.core.errors import ConfigError
from rig.core.sources import Sources
from rig.monitor.access import LOOPBACK_HOST, AccessPolicy, is_loopback

if TYPE_CHECKING:
    from rig.acquire.request import CollectRequest
    from rig.monitor.collection_page import CollectionPage
    from trajectories import Plan


def bench_options(
    parser: argparse.ArgumentParser, *, sources: bool = False
) -> argparse._ArgumentGroup:
    """Add --sensor or --bench, --benches and --world; return the group of a mock bench's options.

    Args:
        parser: Parser of the command.
        sources: If true, add the options for real recordings that a mock bench plays.
    """
    bench = parser.add_argument_group("bench")
    chosen = bench.add_mutually_exclusive_group()
    chosen.add_argument(
        "--sensor",
        metavar="NAME",
        help="name of a bench file, searched in benches/lab/, benches/ and the package",
    )
    chosen.add_argument("--bench", type=Path, metavar="FILE", help="path of a bench file")
    benches_option(bench)
    group = parser.add_argument_group("mock bench only")
    group.add_argument(
        "--world",
        choices=("sim",),
        help="simulate the contact by `sim` in place of the bench file's formulae",
    )
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
    parser.add_argument(
        "--benches",
        type=Path,
        default=Path("benches"),
        metavar="DIR",
        help="folder of bench files (%(default)s)",
    )


def bench_path(options: argparse.Namespace) -> Path:
    """Return the bench file of --bench or --sensor, or that of the session to resume.

    Raises:
        ConfigError: Neither option is given, or the file does not exist.
        SessionError: The session to resume cannot be read.
    """
    if options.bench is not None:
        path: Path = options.bench
        return path
    sensor = options.sensor
    if sensor is None and getattr(options, "resume", None) is not None:
        sensor = Session(options.resume).attrs["sensor"]
    if sensor is None:
        raise ConfigError("--sensor, --bench: both missing; allowed: one of them")
    return find_bench(sensor, options.benches)


def chosen_bench(options: argparse.Namespace) -> BenchFile:
    """Return the selected bench file, with --world and --force applied.

    A resumed session continues in the world in which it began, and without a gauge if it began so.

    Raises:
        ConfigError: See `rig.core.config`; or the bench has no simulated world.
        SessionError: The session to resume cannot be read.
    """
    path = bench_path(options)
    content = read_content(path)
    resumed = getattr(options, "resume", None)
    began = {} if resumed is None else Session(resumed).attrs["bench"]
    if options.world is not None or (began.get("world") or {}).get("kind") == SimulatedSpec.KIND:
        content = with_simulated_world(content, str(path))
    if options.force is not None or (began.get("force") == NO_GAUGE and content.get("mock")):
        content = without_gauge(content, str(path))
    return BenchFile.of(content, path)


def resumed_indenter(options: argparse.Namespace) -> str:
    """Return the indenter of the session to resume; empty if none is resumed.

    A name from before indenters had to be known is returned as empty: the bench's own is checked.
    """
    if options.resume is None:
        return ""
    name = Session(options.resume).attrs.get("indenter")
    return name if name in indenter_names() else ""


def sources_of(options: argparse.Namespace, file: BenchFile) -> Sources:
    """Return the recordings of --camera, --still and --taxels.

    Raises:
        ConfigError: A path does not exist, or the bench has no device that could play it.
    """
    path, bench = file.path, file.bench
    for option, given, device in (
        ("CAMERA", options.camera, bench.of_kind("camera")),
        ("TAXELS", options.taxels, bench.of_kind("taxels")),
    ):
        if given is None:
            continue
        if not bench.mock:
            raise ConfigError(f"{option}: {path} is a lab bench; allowed: a mock bench")
        if not device:
            lacks = "camera" if option == "CAMERA" else "taxels"
            raise ConfigError(
                f"{option}: found {given}; {path} has no {lacks}: nothing would play it"
            )
    if options.still and options.camera is None:
        raise ConfigError("STILL: goes with CAMERA only")
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


def confirm_motion(bench: Bench, depth: float, by: int | None = None) -> None:
    """State how a lab bench's arm will move, and wait for a word; a mock bench asks nothing.

    Args:
        bench: The bench with the limits that will hold.
        depth: Deepest indentation that is planned [m].
        by: Process id of the campaign that has asked already, the parent of this process.

    Raises:
        ConfigError: There is no terminal to ask on.
        Interrupted: The answer was not the word.
    """
    if bench.mock or by == os.getppid():
        return
    confirm(motion_lines(bench, depth))


def confirm_options(parser: argparse.ArgumentParser) -> None:
    """Add the option by which a campaign says that it has asked; not shown in the help."""
    parser.add_argument("--asked-by", type=int, help=argparse.SUPPRESS)


def bench_command(name: str, options: argparse.Namespace, **others: object) -> str:
    """Return the command to continue with on the bench of these options.

    Args:
        name: The command.
        options: Those of a command with `bench_options`.
        others: Further options of the command and their values; those of None are left out.
    """
    chosen = {key: getattr(options, key) for key in ("sensor", "bench", "world", "force")}
    benches = None if options.benches == Path("benches") else options.benches
    return next_command(name, **chosen, **others, benches=benches)


def free_path(path: Path) -> Path:
    """Return `path`, or the first of NAME-2.zarr, NAME-3.zarr ... that does not exist."""
    found, number = path, 1
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found


def log_to(path: Path) -> None:
    """Log messages from level INFO to the terminal and, with times, to `path`."""
    terminal = logging.StreamHandler()
    terminal.setFormatter(logging.Formatter("%(message)s"))
    file = logging.FileHandler(path)
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[terminal, file])


# Calibration options of the commands that record.


def calibration_options(parser: argparse.ArgumentParser) -> None:
    """Add --calibrations."""
    parser.add_argument(
        "--calibrations",
        type=Path,
        default=store.FOLDER,
        metavar="DIR",
        help="folder of the results of home and calibrate-latency (%(default)s)",
    )


def calibration_of(options: argparse.Namespace, bench: Bench) -> Calibration:
    """Load the calibration of this session: from the store, or from the session to resume.

    Prints the calibration and warnings.

    Args:
        options: Options with `calibrations` and possibly `resume`.
        bench: The bench as described by its file, with the indenter on its arm.

    Raises:
        ConfigError: The calibration is invalid; see `rig.acquire.calibration.store.load`.
        SessionError: The session to resume cannot be read.
    """
    resumed: Path | None = getattr(options, "resume", None)
    warnings: list[str] = []
    if resumed is not None:
        description = Session(resumed).attrs.get("calibration") or {}
        calibration = Calibration.from_attrs(description)
    else:
        calibration, warnings = store.load(options.calibrations, bench, bench.indenter)
    for line in (*calibration.lines(), *(f"warning: {warning}" for warning in warnings)):
        print(line, flush=True)
    return calibration


# The page that a command serves.


def add_page(
    parser: argparse._ActionsContainer,
    option: str,
    what: str,
    default: AccessPolicy | None = None,
) -> None:
    """Add an option with the address of a page.

    Args:
        parser: Parser of the command.
        option: Name of the option.
        what: Its help, without the address.
        default: Address without the option; None: no page is served then.
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
    """Check the address of a page before anything is started.

    Raises:
        ConfigError: It is not this machine's, or its port is in use.
    """
    if access is None:
        return
    try:
        family, kind, _, _, address = socket.getaddrinfo(
            access.host, access.port, type=socket.SOCK_STREAM
        )[0]
        with socket.socket(family, kind) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise ConfigError(
            f"{option}: found {access.host}:{access.port}: {error.strerror or error}; "
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
    options: argparse.Namespace,
    bench: Bench,
    folder: Path,
    request: CollectRequest,
    plan: Plan,
    total: int,
) -> Iterator[CollectionPage | None]:
    """Run the monitoring page during the context; yield None without --watch.

    Raises:
        ConfigError: The port or the address cannot be used.
    """
    access: AccessPolicy | None = options.watch
    if access is None:
        yield None
        return
    from rig.monitor.collection import CollectionJob
    from rig.monitor.collection_page import CollectionPage
    from rig.monitor.lab import Folders
    from rig.monitor.page_process import PageSettings

    folders = Folders(request.path.parent, options.benches, options.calibrations)
    settings = PageSettings(access, folders, "--watch")
    job = CollectionJob.of(bench, folder, request, plan, total)
    with CollectionPage(settings, job) as page:
        print("\n".join(page_lines(access, page.urls, "see, pause and abort")), flush=True)
        yield page
