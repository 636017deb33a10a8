"""Command line of the rig: `python -m rig collect|preview|compare|mock`."""

from __future__ import annotations

import argparse
import contextlib
import logging
import sys
import tempfile
from pathlib import Path

from recorder import Session, SessionError
from rig.bench import bench_from, find_bench, load_bench
from rig.clock import file_stamp
from rig.collect.collector import Collector
from rig.collect.interrupt import Interrupted
from rig.collect.order import Order, plan_of
from rig.errors import (
    EXIT_DEVICE_LOST,
    EXIT_INTERRUPTED,
    EXIT_SAFETY_STOP,
    EXIT_WRONG_INPUT,
    ConfigError,
    DeviceLost,
    SafetyStop,
)
from rig.mock import MockBench, Sources

logger = logging.getLogger("rig")


def _arguments() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m rig", description="The tactile bench.")
    verbs = parser.add_subparsers(dest="verb", required=True)

    bench = argparse.ArgumentParser(add_help=False)
    chosen = bench.add_mutually_exclusive_group()
    chosen.add_argument("--sensor", help="name of a bench file: benches/lab/ first, then benches/")
    chosen.add_argument("--bench", type=Path, help="path of a bench file")
    bench.add_argument("--benches", type=Path, default=Path("benches"), help="folder of them")

    sources = argparse.ArgumentParser(add_help=False)
    sources.add_argument(
        "--camera",
        type=Path,
        help="mock bench: serve this folder of images or video file in place of the World's view",
    )
    sources.add_argument(
        "--still",
        action="store_true",
        help="declare --camera a still scene: each image is held for seconds",
    )
    sources.add_argument("--taxels", type=Path, help="mock bench: serve this (T,48) .npy of counts")

    collect = verbs.add_parser(
        "collect", parents=[bench, sources], help="record one session along the bench's plan"
    )
    collect.add_argument("--out", type=Path, help="session to write (default: in sessions/)")
    collect.add_argument(
        "--resume", type=Path, help="continue this stopped session (its sensor is known)"
    )
    collect.add_argument("--targets", type=int, help="press only the first N targets")
    collect.add_argument("--indenter", help="name of the indenter on the arm")
    collect.add_argument("--operator", default="", help="who records (default: the login name)")
    collect.add_argument("--truth", type=Path, help="mock bench: log the World's truth here")

    preview = verbs.add_parser("preview", parents=[bench], help="draw the plan, check its limits")
    preview.add_argument("--out", type=Path, help="PNG to write (default: in sessions/)")

    compare = verbs.add_parser("compare", help="hold a mock session against the World's truth")
    compare.add_argument("--session", type=Path, required=True, help="a session")
    compare.add_argument("--truth", type=Path, required=True, help="what collect --truth wrote")

    verbs.add_parser("mock", parents=[bench, sources], help="run the emulators until Ctrl-C")
    return parser


def _bench_path(options: argparse.Namespace) -> Path:
    if options.bench is not None:
        path: Path = options.bench
        return path
    sensor = options.sensor
    if sensor is None and getattr(options, "resume", None) is not None:
        sensor = Session(options.resume).attrs["sensor"]
    if sensor is None:
        raise ConfigError("--sensor, --bench: both missing; allowed: one of them")
    return find_bench(sensor, options.benches)


def _sources(options: argparse.Namespace) -> Sources:
    motion = "still" if options.still else "moving"
    return Sources(camera=options.camera, camera_motion=motion, taxels=options.taxels)


def _banner(mock: bool, path: Path) -> str:
    if mock:
        return (
            f"MOCK BENCH ({path}): every device is an emulator, no arm moves; "
            "time limits are looser than a lab's"
        )
    return f"LAB BENCH ({path}): the arm WILL move"


def _collect(options: argparse.Namespace) -> int:
    path = _bench_path(options)
    bench, content = load_bench(path)
    print(_banner(bench.mock, path), flush=True)
    if options.indenter:
        content = {**content, "indenter": options.indenter}
    sources = _sources(options)
    if not bench.mock and (sources.facts() or options.truth):
        raise ConfigError(f"{path}: CAMERA, TAXELS and truth are for a mock bench; mock: false")
    if options.resume and (options.out or options.targets):
        raise ConfigError("--resume: neither --out nor --targets go with it: the session has both")
    session = options.resume or options.out
    if session is None:
        indenter = content.get("indenter", bench.indenter)
        session = Path("sessions") / f"{bench.sensor}-{indenter}-{file_stamp()}.zarr"
    order = Order(
        path=session,
        resume=options.resume is not None,
        targets=options.targets,
        operator=options.operator,
        mock_facts=sources.facts() if bench.mock else None,
    )
    plan, total = plan_of(order, bench)
    session.parent.mkdir(parents=True, exist_ok=True)
    _log_to(session.with_suffix(".log"))
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-")))
        watch = None
        if bench.mock:
            mock = stack.enter_context(
                MockBench(content, str(path), folder, sources=sources, truth=options.truth)
            )
            content, watch = mock.content, mock.check
        collector = Collector(bench_from(content, str(path)), content, folder, watch)
        return collector.run(order, plan, total)


def _preview(options: argparse.Namespace) -> int:
    from rig.preview import preview

    path = _bench_path(options)
    bench, _ = load_bench(path)
    picture = options.out or Path("sessions") / f"{bench.sensor}-plan.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    return preview(bench, picture)


def _compare(options: argparse.Namespace) -> int:
    from rig.world.compare import compare

    print("\n".join(compare(options.session, options.truth)))
    return 0


def _mock(options: argparse.Namespace) -> int:
    path = _bench_path(options)
    bench, content = load_bench(path)
    if not bench.mock:
        raise ConfigError(f"{path}.mock: false; allowed: a mock bench")
    with (
        tempfile.TemporaryDirectory(prefix="tactile-rig-") as folder,
        MockBench(content, str(path), Path(folder), sources=_sources(options)) as mock,
    ):
        print(_banner(True, path))
        print(f"arm {mock.bench.arm.host}  force {mock.bench.force.host}")
        for config in (mock.bench.camera, mock.bench.taxels):
            if config is not None:
                print(config.address)
        print("Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            for process in mock.processes.values():
                process.wait()
    return 0


def _log_to(path: Path) -> None:
    """Everything from INFO on to the terminal and, with times, to `path`."""
    terminal = logging.StreamHandler()
    terminal.setFormatter(logging.Formatter("%(message)s"))
    file = logging.FileHandler(path)
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[terminal, file])


def main(argv: list[str] | None = None) -> int:
    """Run one verb; the exit code."""
    options = _arguments().parse_args(argv)
    verbs = {"collect": _collect, "preview": _preview, "compare": _compare, "mock": _mock}
    try:
        return verbs[options.verb](options)
    except ConfigError as error:
        print(f"wrong input: {error}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except DeviceLost as error:
        print(f"device lost: {error}; nothing was recorded", file=sys.stderr)
        return EXIT_DEVICE_LOST
    except SafetyStop as error:
        print(f"safety stop: {error}; nothing was recorded", file=sys.stderr)
        return EXIT_SAFETY_STOP
    except SessionError as error:
        print(f"session: {error}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except (KeyboardInterrupt, Interrupted):
        print("interrupted; nothing was recorded", file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
