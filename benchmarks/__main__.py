"""Command line of the benchmarks: `python -m benchmarks NAME [options]`, from the repository."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True, slots=True)
class Benchmark:
    """One benchmark program."""

    module: str
    """Module with either `add_to(parsers)` or `main(arguments)`."""
    package: str
    """Package whose error handling and exit codes apply: `rig`, `sim` or `learning`."""
    help: str


BENCHMARKS = {
    # Recording
    "recording": Benchmark(
        "benchmarks.recording.command", "rig", "cost of recording, compared with other stores"
    ),
    "faults": Benchmark("benchmarks.faults.command", "rig", "inject every fault into a mock bench"),
    "endurance": Benchmark("benchmarks.endurance.command", "rig", "half an hour on the mock bench"),
    # The simulator
    "hard-cases": Benchmark(
        "benchmarks.sim.stability.command", "sim", "cases that break simulators"
    ),
    "refine": Benchmark(
        "benchmarks.sim.refinement.command", "sim", "force from coarse to fine meshes"
    ),
    "accuracy": Benchmark(
        "benchmarks.sim.accuracy.command", "sim", "error against time and memory"
    ),
    "speed": Benchmark("benchmarks.sim.speed.command", "sim", "the paper's 162 presses timed"),
    "frames": Benchmark(
        "benchmarks.sim.speed.frames", "sim", "frames per second, one press or many at once"
    ),
    "effects": Benchmark(
        "benchmarks.sim.effects.command", "sim", "cost of each effect, on and off"
    ),
    "needed": Benchmark(
        "benchmarks.sim.needed", "sim", "insignificant effects, left out of random scenes"
    ),
    "layer": Benchmark("benchmarks.sim.tiers.layer", "sim", "the `layer` tier, error and time"),
    "mpm": Benchmark("benchmarks.sim.tiers.mpm", "sim", "the `mpm` tier compared with `fem`"),
    "independent": Benchmark(
        "benchmarks.sim.independent.command", "sim", "forces compared with other mechanics programs"
    ),
    "tolerance": Benchmark(
        "benchmarks.sim.tolerance_kept", "sim", "are tolerances met on random scenes"
    ),
    "render-check": Benchmark(
        "benchmarks.sim.render.check", "sim", "marker images against ray casting"
    ),
    "render-speed": Benchmark("benchmarks.sim.render.timing", "sim", "marker images per second"),
    "render-picture": Benchmark(
        "benchmarks.sim.render.picture", "sim", "draw markers before and after"
    ),
    "blender": Benchmark("benchmarks.sim.render.blender", "sim", "the same images by Blender"),
    "sensor-fit": Benchmark("benchmarks.sim.sensors.fit", "sim", "fit the sensors' parameters"),
    "sensor-speed": Benchmark(
        "benchmarks.sim.sensors.timing", "sim", "time a frame of each sensor"
    ),
    "sensor-picture": Benchmark(
        "benchmarks.sim.sensors.picture", "sim", "draw one press on every sensor"
    ),
    "live-forces": Benchmark(
        "benchmarks.sim.sensors.accuracy", "sim", "live forces compared with `layer` and `fem`"
    ),
    "live-session": Benchmark(
        "benchmarks.sim.sensors.stream_accuracy", "sim", "a session solved again"
    ),
    "patterns": Benchmark("benchmarks.sim.pictures.patterns", "sim", "draw all marker patterns"),
    "indenters": Benchmark("benchmarks.sim.pictures.indenters", "sim", "draw all indenters"),
    # Learning
    "latency": Benchmark(
        "benchmarks.learning.latency.command", "learning", "error against time and size"
    ),
    "field-speed": Benchmark(
        "benchmarks.learning.field_rate", "learning", "field translator, frames/s"
    ),
    "diffusion-full-size": Benchmark(
        "benchmarks.learning.diffusion_full_size",
        "learning",
        "diffusion at the paper's size, on a GPU",
    ),
    "learning-tables": Benchmark(
        "benchmarks.learning.tables.command", "learning", "the paper's tables"
    ),
    "learning-on-gpus": Benchmark(
        "benchmarks.learning.tables.on_gpus", "learning", "all tables and ablations, on all GPUs"
    ),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one benchmark and return its exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_listing())
        return 0
    name = arguments[0]
    known = BENCHMARKS.get(name)
    if known is None:
        print(f"wrong input: {name!r}; allowed: {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    module = import_module(known.module)
    if hasattr(module, "main"):
        return int(module.main(arguments[1:]) or 0)
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parsers = parser.add_subparsers(dest="verb", required=True)
    module.add_to(parsers)
    return int(_run(known.package, parser, [name, *arguments[1:]]))


def _run(package: str, parser: argparse.ArgumentParser, arguments: list[str]) -> int:
    """Run a subcommand with the error handling and exit codes of its package."""
    front: Any = import_module(f"{package}.__main__")
    return int(front.run(parser, arguments))


def _listing() -> str:
    width = max(map(len, BENCHMARKS))
    rows = [f"  {name:{width}}  {known.help}" for name, known in BENCHMARKS.items()]
    return "\n".join(
        ["usage: python -m benchmarks NAME [options]; NAME --help has them", "", *rows]
    )


if __name__ == "__main__":
    sys.exit(main())
