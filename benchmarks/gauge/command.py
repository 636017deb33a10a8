"""Forces on a sensor without a gauge, from the weakest way to the strongest.

    python -m benchmarks gauge --device cuda:0 --fit fem
    python -m benchmarks gauge --quick

Archives, twins and networks stay in `--work`; a repeated command goes on there.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.report import Benchmark, Page, Part, Run
from recorder.command_line.options import names, whole


def _ladder(group: str, run: Run) -> dict[str, Any]:
    from benchmarks.gauge.ladder import measure

    return measure(run, group)


def _coverage(run: Run) -> dict[str, Any]:
    from benchmarks.gauge.skins import measure

    return measure(run)


def _extrapolation(run: Run) -> dict[str, Any]:
    from benchmarks.gauge.extrapolation import measure

    return measure(run)


def _section(part: str, values: Any, page: Page) -> str:
    from benchmarks.gauge import extrapolation, skins
    from benchmarks.gauge.page import section

    of_part = {"coverage": skins.section, "extrapolation": extrapolation.section}
    return of_part[part](values, page) if part in of_part else section(part, values, page)


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
    add("--skins", type=whole(0), default=0, metavar="N", help="seed of the sensors (%(default)s)")
    add(
        "--fit",
        choices=("layer", "fem"),
        default="layer",
        help="tier of twins and their labels (%(default)s)",
    )
    add("--targets", type=whole(2, 48), metavar="N", help="targets of an indenter (8)")
    add("--steps", type=whole(4), metavar="N", help="steps of a net from nothing (1000)")
    add(
        "--work",
        type=Path,
        metavar="DIR",
        help="folder of archives, twins and networks, where a repeated command goes on "
        "(build/benchmarks; with --quick none)",
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
        Part("coverage", _coverage, partial(_section, "coverage"), 1),
        Part("extrapolation", _extrapolation, partial(_section, "extrapolation"), 1),
    ],
    _summary,
    add_options,
    on_device=True,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
