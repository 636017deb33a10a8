"""The paper's chain trained from nothing, beside simple baselines and the paper's own figures.

python -m benchmarks paper --device cuda:0              # the whole page
python -m benchmarks paper --quick --only patterns --minutes 1    # the chain at toy size
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

from benchmarks.report import Benchmark, Page, Part, Run
from recorder.command_line.options import positive


def _measured(part: str, run: Run) -> dict[str, Any]:
    from benchmarks.paper.chain import measured
    from benchmarks.paper.sizes import SIZES, toy
    from benchmarks.paper.study import folder_of

    size = toy(part) if run.quick else SIZES[part]
    minutes = size.minutes if run.options.minutes is None else run.options.minutes
    return measured(run, folder_of(run, f"paper-{part}"), size, minutes)


def _section(part: str, values: Any, page: Page) -> str:
    from benchmarks.paper.page import section

    return section(part, values, page)


def _full_size(run: Run) -> dict[str, Any]:
    from benchmarks.paper import full_size

    return full_size.measure(run)


def _full_size_section(values: Any, page: Page) -> str:
    from benchmarks.paper import full_size

    return full_size.section(values, page)


def _summary(values: dict[str, Any]) -> str:
    from benchmarks.paper.page import summary

    return summary(values)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the option of this benchmark."""
    parser.add_argument(
        "--minutes",
        type=positive,
        metavar="N",
        help="training time of a part's translator; other networks get shares of it "
        "(1.5 to 2.5, by part; with --quick a few steps)",
    )


NEEDS = "the extra `diffusion`; a GPU in a complete run"
BENCHMARK = Benchmark(
    "paper",
    "The paper by its own models",
    "Do the paper's two networks, trained from nothing on simulated sensors in minutes, beat "
    "simple baselines on indenters that they never saw, and what does diffusion cost at full size?",
    [
        *(
            Part(part, partial(_measured, part), partial(_section, part), 3, NEEDS)
            for part in ("patterns", "skins", "kinds")
        ),
        Part("full-size", _full_size, _full_size_section, 1, "a GPU of 60 GiB"),
    ],
    _summary,
    add_options,
    on_device=True,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
