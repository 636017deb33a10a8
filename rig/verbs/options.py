"""Options that several verbs have, and what they mean."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recorder import Session
from rig.bench import Bench, bench_from, find_bench, load_bench, with_simulated_world
from rig.emulators import Sources
from rig.errors import ConfigError
from rig.world.simulated import SimulatedSpec

if TYPE_CHECKING:
    Verbs = argparse._SubParsersAction[argparse.ArgumentParser]


def bench_options() -> argparse.ArgumentParser:
    """Which bench: --sensor or --bench, and --benches."""
    parser = argparse.ArgumentParser(add_help=False)
    chosen = parser.add_mutually_exclusive_group()
    chosen.add_argument("--sensor", help="name of a bench file: benches/lab/ first, then benches/")
    chosen.add_argument("--bench", type=Path, help="path of a bench file")
    parser.add_argument("--benches", type=Path, default=Path("benches"), help="folder of them")
    parser.add_argument(
        "--world",
        choices=("sim",),
        help="mock bench: what the simulator says, in place of the bench file's world",
    )
    return parser


def source_options() -> argparse.ArgumentParser:
    """Real recordings for a mock bench to serve."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument(
        "--camera",
        type=Path,
        help="mock bench: serve this folder of images or video file in place of the World's view",
    )
    parser.add_argument(
        "--still",
        action="store_true",
        help="declare --camera a still scene: each image is held for seconds",
    )
    parser.add_argument("--taxels", type=Path, help="mock bench: serve this (T,48) .npy of counts")
    return parser


def bench_path(options: argparse.Namespace) -> Path:
    """The bench file that --bench or --sensor names, or that a session to resume was made with.

    Raises:
        ConfigError: None is named, or the named one does not exist.
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
    """File, bench and content of what `bench_path` finds, with the world that --world names.

    A session to resume goes on in the world that it began in.

    Raises:
        ConfigError: See `rig.config`; or a bench that has no such world.
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
    """What --camera, --still and --taxels say.

    Raises:
        ConfigError: A path that is not there.
    """
    motion = "still" if options.still else "moving"
    return Sources(camera=options.camera, camera_motion=motion, taxels=options.taxels)


def banner(mock: bool, path: Path) -> str:
    """The first line printed: nobody shall take a mock bench for the lab's, or the reverse."""
    if mock:
        return (
            f"MOCK BENCH ({path}): every device is an emulator, no arm moves; "
            "time limits are looser than a lab's"
        )
    return f"LAB BENCH ({path}): the arm WILL move"


def log_to(path: Path) -> None:
    """Everything from INFO on to the terminal and, with times, to `path`."""
    terminal = logging.StreamHandler()
    terminal.setFormatter(logging.Formatter("%(message)s"))
    file = logging.FileHandler(path)
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[terminal, file])
