"""The paper's chain trained from nothing, beside simple baselines and the paper's own figures.

    python -m benchmarks paper --device cuda:0              # the whole page
    python -m benchmarks paper --quick --only patterns --minutes 1    # the chain at toy size

Archives and networks stay in `--work`; a repeated command goes on there.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.report import QUICK_RESULTS, RESULTS, Benchmark, Page, Part, Run
from learning.evaluation.translation import NEAREST
from recorder.command_line.options import positive


def _measured(part: str, run: Run) -> dict[str, Any]:
    from benchmarks.paper import chain
    from benchmarks.paper.sizes import SIZES, toy
    from benchmarks.paper.study import folder_of

    size = toy(part) if run.quick else SIZES[part]
    minutes = size.minutes if run.options.minutes is None else run.options.minutes
    measured = chain.measured_memory if part == "memory" else chain.measured
    return measured(run, folder_of(run, f"paper-{part}"), size, minutes)


def _full_size(run: Run) -> dict[str, Any]:
    from benchmarks.paper import full_size

    return full_size.measure(run)


def _section(part: str, values: Any, page: Page) -> str:
    from benchmarks.paper import full_size
    from benchmarks.paper.page import memory_section, section

    if part == "full-size":
        return full_size.section(values, page)
    return memory_section(values, page) if part == "memory" else section(part, values, page)


def _summary(values: dict[str, Any]) -> str:
    from benchmarks.paper.page import summary

    return summary(values)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument(
        "--minutes",
        type=positive,
        metavar="N",
        help="training time of a part's translator; other networks get shares of it "
        "(1.2 to 2.5, by part; with --quick a few steps)",
    )
    parser.add_argument(
        "--work",
        type=Path,
        metavar="DIR",
        help="folder of archives and networks, where a repeated command goes on "
        "(build/benchmarks; with --quick none)",
    )


BENCHMARK = Benchmark(
    "paper",
    "The paper by its own models",
    "Do the paper's two networks, trained from nothing on simulated sensors in minutes, beat "
    "simple baselines on indenters that they never saw, and what does diffusion cost at full size?",
    [
        *(
            Part(
                part,
                partial(_measured, part),
                partial(_section, part),
                weight,
                "the extra `diffusion`; a GPU in a complete run",
            )
            for part, weight in (("patterns", 3), ("skins", 3), ("kinds", 3), ("memory", 1.5))
        ),
        Part("full-size", _full_size, partial(_section, "full-size"), 1, "a GPU of 60 GiB"),
    ],
    _summary,
    add_options,
    on_device=True,
)
add_arguments = BENCHMARK.add_arguments


def run(options: argparse.Namespace) -> int:
    """Measure, write the page, and end with a line of the result; return the exit code."""
    code = BENCHMARK.run(options)
    page = options.out or (QUICK_RESULTS if options.quick else RESULTS) / "paper.md"
    print(last_line(json.loads(page.with_suffix(".json").read_text(encoding="utf-8"))))
    return code


def last_line(stored: dict[str, Any]) -> str:
    """Return the mean R2 of the chain and two baselines, of the first part that there is."""
    from benchmarks.paper.page import r2

    for part in ("patterns", "skins", "kinds"):
        if part in stored:
            values = stored[part]["results"]
            three = (("paper chain", "m2m"), ("nearest frame", NEAREST), ("displacement",) * 2)
            return "  ".join(f"{words} R2 {r2(values, method)}" for words, method in three)
    return "no chain was trained"
