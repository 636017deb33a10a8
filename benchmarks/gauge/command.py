"""Forces on a sensor without a gauge, from the weakest way to the strongest.

python -m benchmarks gauge --device cuda:0 --fit fem
python -m benchmarks gauge --quick
"""

import argparse
from functools import partial

from benchmarks.gauge import balance, coverage, ladder, page
from benchmarks.gauge.planted import GROUPS
from benchmarks.report import Benchmark, Part
from recorder.command_line.options import names, whole


def seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of an option's value."""
    return tuple(dict.fromkeys(whole(0)(each) for each in names(text)))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    add = parser.add_argument
    add("--seeds", type=seeds, default=(0, 1, 2), metavar="N,...", help="of nets (0,1,2)")
    help_ = "tier of twins and their labels (%(default)s)"
    add("--fit", choices=("layer", "fem"), default="layer", help=help_)


NEEDS = "a GPU, if complete"
BENCHMARK = Benchmark(
    "gauge",
    "Forces without a gauge on the target",
    "Which way gives newtons on a sensor that was pressed with a gauge four times, once, or never, "
    "and how good are they?",
    [
        *(
            Part(group, partial(ladder.measure, group), partial(page.section, group), 3, NEEDS)
            for group in GROUPS
        ),
        Part("coverage", coverage.measure, coverage.section),
        Part("balance", balance.measure, balance.section),
    ],
    page.summary,
    add_options,
    on_device=True,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
