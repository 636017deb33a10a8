"""`tactile mock`: run only the emulators of a bench, for use with other tools."""

import argparse
import contextlib
import tempfile
from pathlib import Path

from rig.cli.options import banner, bench_options, chosen_bench, sources_of
from rig.core.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser, sources=True)


def run(options: argparse.Namespace) -> int:
    """Serve until Ctrl-C."""
    from rig.mock.bench import MockBench

    file = chosen_bench(options)
    if not file.bench.mock:
        raise ConfigError(f"{file.path}.mock: false; allowed: a mock bench")
    file = file.with_indenter("")
    sources = sources_of(options, file)
    with (
        tempfile.TemporaryDirectory(prefix="tactile-rig-") as folder,
        MockBench(file, Path(folder), sources=sources) as mock,
    ):
        print(banner(file))
        forces = [f"  {row.name} {row.config.address}" for row in mock.bench.of_kind("force")]
        print(f"arm {mock.bench.arm.host}{''.join(forces)}")
        for row in (*mock.bench.of_kind("camera"), *mock.bench.of_kind("taxels")):
            print(row.config.address if row.listed is False else f"{row.name} {row.config.address}")
        print("Ctrl-C ends it", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            for process in mock.processes.values():
                process.wait()
    return 0
