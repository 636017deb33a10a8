"""Cost of accuracy in time: `python -m benchmarks accuracy`, page docs/results/accuracy.md."""

import argparse

from benchmarks.accuracy import effects, frames, images, solvers, speed
from benchmarks.processes import add_processes
from benchmarks.report import Benchmark, Part
from recorder.processes import cores


def _options(parser: argparse.ArgumentParser) -> None:
    add_processes(parser, default=cores())
    parser.add_argument(
        "--references",
        action="store_true",
        help="solve the forces again that the paper's presses are compared with: minutes on a GPU",
    )


BENCHMARK = Benchmark(
    name="accuracy",
    title="What accuracy costs in time",
    question=(
        "How exact is a force, a surface or a marker image of the simulator, in which time, on a "
        "CPU and on a GPU?"
    ),
    parts=(
        Part("accuracy", solvers.measure, solvers.section, weight=6),
        Part("speed", speed.measure, speed.section, weight=3),
        Part("frames", frames.measure, frames.section, weight=2),
        Part("effects", effects.measure, effects.section, weight=1),
        Part("images", images.measure, images.section, weight=0.5),
    ),
    summary=lambda values: solvers.summary(values) if "accuracy" in values else "",
    options=_options,
    on_device=True,
)

add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
