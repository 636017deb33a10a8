"""`python -m rig mock`: run only the emulators of a bench, for use with other tools."""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from rig.cli.options import banner, bench_options, chosen_bench, source_options, sources_of
from rig.core.errors import ConfigError

if TYPE_CHECKING:
    from rig.cli.options import Subcommands


def add_to(subcommands: Subcommands) -> None:
    """Add the verb and its options."""
    parser = subcommands.add_parser(
        "mock",
        parents=[bench_options(), source_options()],
        help="run the emulators of a bench until Ctrl-C",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C.

    Raises:
        ConfigError: The bench is no mock bench.
    """
    from rig.mock.bench import MockBench

    path, bench, content = chosen_bench(options)
    if not bench.mock:
        raise ConfigError(f"{path}.mock: false; allowed: a mock bench")
    with (
        tempfile.TemporaryDirectory(prefix="tactile-rig-") as folder,
        MockBench(content, str(path), Path(folder), sources=sources_of(options)) as mock,
    ):
        print(banner(True, path))
        print(f"arm {mock.bench.arm.host}  force {mock.bench.force.address}")
        for config in (mock.bench.camera, mock.bench.taxels):
            if config is not None:
                print(config.address)
        print("Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            for process in mock.processes.values():
                process.wait()
    return 0
