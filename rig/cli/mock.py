"""`python -m rig mock`: run only the emulators of a bench, for use with other tools."""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from pathlib import Path

from rig.cli.options import banner, bench_options, chosen_bench, sources_of, with_indenter
from rig.core.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser, sources=True)


def run(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C.

    Raises:
        ConfigError: The bench is no mock bench.
    """
    from rig.mock.bench import MockBench

    path, bench, content = chosen_bench(options)
    if not bench.mock:
        raise ConfigError(f"{path}.mock: false; allowed: a mock bench")
    content, _ = with_indenter(content, bench, None)
    sources = sources_of(options, path, bench)
    with (
        tempfile.TemporaryDirectory(prefix="tactile-rig-") as folder,
        MockBench(content, str(path), Path(folder), sources=sources) as mock,
    ):
        print(banner(True, path))
        forces = [f"  {row.name} {row.config.address}" for row in mock.bench.of_kind("force")]
        print(f"arm {mock.bench.arm.host}{''.join(forces)}")
        for row in (*mock.bench.of_kind("camera"), *mock.bench.of_kind("taxels")):
            print(row.config.address if row.listed is False else f"{row.name} {row.config.address}")
        print("Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            for process in mock.processes.values():
                process.wait()
    return 0
