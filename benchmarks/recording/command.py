"""`python -m benchmarks recording`: what recording costs and loses, and how fast it is read."""

import argparse
from collections.abc import Callable
from importlib import import_module
from typing import Any

from benchmarks.recording import alignment, comparison, load
from benchmarks.report import Benchmark, Part, table
from recorder.command_line.options import whole


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--repeats", type=whole(1, 100), default=5, help="of each store (%(default)s)")
    parser.epilog = "The disk that is measured is that of TMPDIR; it needs about 16 GB."


def summary(results: dict[str, Any]) -> str:
    """Return the frames a second that can be kept, and the goals, with whether they are reached."""
    goals: dict[str, Callable[[Any], list[tuple[str, str, bool]]]]
    goals = {"stores": comparison.goals, "load": load.goals, "alignment": alignment.goals}
    lines = [line for name, of in goals.items() if name in results for line in of(results[name])]
    rows = [[goal, measured, "yes" if reached else "**no**"] for goal, measured, reached in lines]
    trials = results.get("load", {}).get("trials")
    goals_table = table(["goal", "measured", "reached"], rows) if rows else ""
    return f"{load.capacity(results['load'])}\n\n{goals_table}" if trials else goals_table


def _learning(name: str) -> Part:
    """Return a part that needs torch: its module is imported when it is used."""

    def module() -> Any:
        return import_module(f"benchmarks.recording.{name}")

    return Part(
        name,
        lambda run: module().measure(run),
        lambda values, page: str(module().section(values, page)),
        needs="the extra learning",
    )


BENCHMARK = Benchmark(
    name="recording",
    title="Recording",
    question="What does recording cost beside other stores, what is lost when a writer is killed, "
    "how many streams can a machine keep, how well do labels fit their images, and how fast are "
    "windows and forces read?",
    parts=(
        Part("stores", comparison.measure, comparison.section, 8, "the extra bench"),
        Part("load", load.measure, load.section, 6),
        Part("alignment", alignment.measure, alignment.section, 0.5),
        _learning("loading"),
        _learning("latency"),
    ),
    summary=summary,
    options=_options,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
