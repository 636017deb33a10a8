"""Hard cases for the simulator: `python -m benchmarks hard-cases`."""

from __future__ import annotations

import argparse
from typing import Any

from benchmarks.hard_cases import mistakes, named_cases, refinement
from benchmarks.hard_cases.random_scenes import judgement as random_scenes
from benchmarks.processes import add_processes
from benchmarks.report import QUICK_RESULTS, Benchmark, Part
from recorder.command_line.options import add_seed, whole


def _options(parser: argparse.ArgumentParser) -> None:
    add_processes(parser, default=2)
    add = parser.add_argument
    add(
        "--case",
        action="append",
        default=[],
        metavar="NAME",
        help="run this case only, * and ? are wildcards (may be repeated)",
    )
    count = whole(1, 100_000)
    add("--scenes", type=count, default=300, metavar="N", help="random scenes (%(default)s)")
    add("--first", type=whole(0), default=0, metavar="I", help="first scene (%(default)s)")
    add_seed(parser)
    add("--seconds", type=whole(1, 3600), default=60, help="limit of a random scene (%(default)s)")


def _summary(values: dict[str, Any]) -> str:
    """Return the results in two sentences."""
    lines = []
    if reports := values.get("cases"):
        failed = sum(bool(report["failures"]) for report in reports.values())
        lines.append(f"**{len(reports)} cases, {len(reports) - failed} passed.**")
    if outcomes := values.get("random"):
        kinds = [one["class"] for one in outcomes]
        answers = kinds.count("right") + kinds.count("warned")
        without = kinds.count("refused") + kinds.count("diverged")
        lines.append(
            f"Of {len(kinds)} random scenes, {answers} have an answer that is right within its "
            f"stated error or warns, {without} are refused or diverge with a message, "
            f"{kinds.count('timeout')} have no answer in time, and {kinds.count('silent')} are "
            f"silently wrong, {kinds.count('crash')} crash."
        )
    return " ".join(lines)


BENCHMARK = Benchmark(
    "hard-cases",
    "Hard cases",
    "Is the finite-element solver right, or does it say that it has no answer, in scenes that "
    "break simulators?",
    (
        Part("cases", named_cases.measure, named_cases.section, weight=4),
        Part("mistakes", mistakes.measure, mistakes.section),
        Part("random", random_scenes.measure, random_scenes.section, weight=20),
        Part("refinement", refinement.measure, refinement.section, weight=3),
    ),
    summary=_summary,
    options=_options,
    on_device=True,
)
add_arguments = BENCHMARK.add_arguments


def run(options: argparse.Namespace) -> int:
    """Run the benchmark; some of the cases or scenes only make no page of results.

    Raises:
        SceneError: Unknown case or device.
    """
    if (options.case or options.first) and options.out is None:
        options.out = QUICK_RESULTS / "hard-cases.md"
    return BENCHMARK.run(options)
