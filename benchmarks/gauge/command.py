"""Forces on a sensor without a gauge, from the weakest way to the strongest.

python -m benchmarks gauge --device cuda:0 --fit fem
python -m benchmarks gauge --quick
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

from benchmarks.report import Benchmark, Page, Part, Run
from recorder.command_line.options import names, whole


def _ladder(group: str, run: Run) -> dict[str, Any]:
    from benchmarks.gauge.ladder import measure

    return measure(run, group)


def _coverage(run: Run) -> dict[str, Any]:
    from benchmarks.gauge.skins import measure

    return measure(run)


def _section(group: str, values: Any, page: Page) -> str:
    from benchmarks.gauge.page import section

    return section(group, values, page)


def _coverage_section(values: Any, page: Page) -> str:
    from benchmarks.gauge import skins

    return skins.section(values, page)


def _summary(values: dict[str, Any]) -> str:
    from benchmarks.gauge.page import summary

    return summary(values)


def seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of an option's value."""
    return tuple(whole(0)(each) for each in names(text))


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    add = parser.add_argument
    add("--seeds", type=seeds, default=(0, 1, 2), metavar="N,...", help="of nets (0,1,2)")
    add(
        "--fit",
        choices=("layer", "fem"),
        default="layer",
        help="tier of twins and their labels (%(default)s)",
    )


BENCHMARK = Benchmark(
    "gauge",
    "Forces without a gauge on the target",
    "Which way gives newtons on a sensor that was pressed with a gauge four times, once, or never, "
    "and how good are they?",
    [
        *(
            Part(group, partial(_ladder, group), partial(_section, group), 3, "a GPU, if complete")
            for group in ("kinds", "skins", "patterns")
        ),
        Part("coverage", _coverage, _coverage_section, 1),
    ],
    _summary,
    add_options,
    on_device=True,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
