"""Options shared by several verbs, and the objects made from them."""

from __future__ import annotations

import argparse
import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recorder import Session
from recorder.command_line.options import whole
from rig.acquire.calibration import store
from rig.acquire.calibration.calibration import Calibration
from rig.bench.bench import Bench, bench_from, find_bench, load_bench, with_simulated_world
from rig.bench.worlds import SimulatedSpec
from rig.core.errors import ConfigError
from rig.core.sources import Sources
from rig.monitor.page.access import DEFAULT_PORT, LOOPBACK_HOST, AccessPolicy, is_loopback

if TYPE_CHECKING:
    from rig.acquire.request import CollectRequest
    from rig.monitor.page.page import Page
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
    bench.add_argument(
        "--benches",
        type=Path,
        default=Path("benches"),
        metavar="DIR",
        help="folder of bench files (%(default)s)",
    )
    group = parser.add_argument_group("mock bench only")
    group.add_argument(
        "--world",
        choices=("sim",),
        help="use the simulator in place of the bench file's world",
    )
    if sources:
        group.add_argument(
            "--camera",
            type=Path,
            metavar="PATH",
            help="play this folder of images or video file in place of the World's view",
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


def chosen_bench(options: argparse.Namespace) -> tuple[Path, Bench, dict[str, Any]]:
    """Return file, bench and content of the selected bench, with the world of --world applied.

    A resumed session continues in the world in which it began.

    Raises:
        ConfigError: See `rig.core.config`; or the bench has no simulated world.
        SessionError: The session to resume cannot be read.
    """
    path = bench_path(options)
    bench, content = load_bench(path)
    resumed = getattr(options, "resume", None)
    if options.world is None and (resumed is None or not _began_simulated(resumed)):
        return path, bench, content
    content = with_simulated_world(content, str(path))
    return path, bench_from(content, str(path)), content


def _began_simulated(session: Path) -> bool:
    world = Session(session).attrs["bench"].get("world") or {}
    return bool(world.get("kind") == SimulatedSpec.KIND)


def sources_of(options: argparse.Namespace) -> Sources:
    """Return the recordings of --camera, --still and --taxels.

    Raises:
        ConfigError: A path does not exist.
    """
    motion = "still" if options.still else "moving"
    return Sources(camera=options.camera, camera_motion=motion, taxels=options.taxels)


def banner(mock: bool, path: Path) -> str:
    """Return the first line to print, which states if this is a mock bench or a lab bench."""
    if mock:
        return (
            f"MOCK BENCH ({path}): every device is an emulator, no arm moves; "
            "time limits are looser than a lab's"
        )
    return f"LAB BENCH ({path}): the arm WILL move"


def log_to(path: Path) -> None:
    """Log messages from level INFO to the terminal and, with times, to `path`."""
    terminal = logging.StreamHandler()
    terminal.setFormatter(logging.Formatter("%(message)s"))
    file = logging.FileHandler(path)
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[terminal, file])


# Calibration options of the verbs that record.


def calibration_options(parser: argparse.ArgumentParser) -> None:
    """Add --calibrations."""
    parser.add_argument(
        "--calibrations",
        type=Path,
        default=store.FOLDER,
        metavar="DIR",
        help="folder of the results of home and calibrate-latency (%(default)s)",
    )


def calibration_of(options: argparse.Namespace, bench: Bench, indenter: str) -> Calibration:
    """Load the calibration of this session: from the store, or from the session to resume.

    Prints the calibration and warnings.

    Args:
        options: Options with `calibrations` and possibly `resume`.
        bench: The bench as described by its file.
        indenter: Name of the indenter on the arm.

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
        calibration, warnings = store.load(options.calibrations, bench, indenter)
    for line in (*calibration.lines(), *(f"warning: {warning}" for warning in warnings)):
        print(line, flush=True)
    return calibration


# Options of the monitoring page, and the page opened from them.


def watch_options(parser: argparse.ArgumentParser) -> None:
    """Add --watch and --watch-host."""
    page = parser.add_argument_group("monitoring page")
    page.add_argument(
        "--watch",
        type=whole(0, 0xFFFF),
        nargs="?",
        const=DEFAULT_PORT,
        metavar="PORT",
        help=f"serve a monitoring page (default port {DEFAULT_PORT}; 0: any free port)",
    )
    page.add_argument(
        "--watch-host",
        default=LOOPBACK_HOST,
        metavar="ADDRESS",
        help="address to serve the page on (default: %(default)s, this machine only; any other "
        "address requires a token, which is printed)",
    )


@contextlib.contextmanager
def opened_page(
    options: argparse.Namespace,
    bench: Bench,
    folder: Path,
    request: CollectRequest,
    plan: Plan,
    total: int,
) -> Iterator[Page | None]:
    """Run the monitoring page during the context; yield None without --watch.

    Raises:
        ConfigError: The port or the address cannot be used.
    """
    if options.watch is None:
        if options.watch_host != LOOPBACK_HOST:
            raise ConfigError("--watch-host: goes with --watch only")
        yield None
        return
    from rig.monitor.page.messages import page_job
    from rig.monitor.page.page import Page

    access = AccessPolicy(options.watch_host, options.watch)
    with Page(page_job(access, bench, folder, request, plan, total)) as page:
        print(f"watch it at {page.url}", flush=True)
        if not is_loopback(access.host):
            print(
                "whoever has this address can see, pause and abort: the connection is not encrypted"
            )
        yield page
