"""Hard cases for the simulator: `python -m benchmarks hard-cases`."""

import argparse
from functools import partial
from typing import Any

from benchmarks.hard_cases import mistakes, named_cases, paper_presses, variants
from benchmarks.hard_cases.random_scenes import judgement
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
    random = "random scenes (%(default)s); on cores a fifth as many"
    add("--scenes", type=whole(1, 50_000), default=300, metavar="N", help=random)
    add("--first", type=whole(0), default=0, metavar="I", help="first scene (%(default)s)")
    add_seed(parser)
    add("--seconds", type=whole(1, 3600), default=60, help="time for an answer (%(default)s)")


def _summary(values: dict[str, Any]) -> str:
    """Return the results in two sentences."""
    lines = []
    if reports := values.get("cases"):
        failed = sum(bool(report["failures"]) for report in reports.values())
        lines.append(f"**{len(reports)} cases, {len(reports) - failed} passed.**")
    for name in ("random", "cores", "variants"):
        if rows := values.get(name):
            answers = [row for row in rows if row.get("stated") is not None]
            lines.append(
                f"Of {len(rows)} scenes of part {name}, {len(answers)} are answered with a stated "
                f"error, which holds in {sum(map(judgement.holds, answers))}; "
                f"{sum(map(judgement.silent, answers))} are silently wrong."
            )
    return " ".join(lines)


CORES = "Random scenes, one core each"
BENCHMARK = Benchmark(
    "hard-cases",
    "Hard cases",
    "Is the simulator right, or does it say how far it may be off, in scenes that break "
    "simulators, and in random ones?",
    (
        Part("cases", named_cases.measure, named_cases.section, weight=4),
        Part("mistakes", mistakes.measure, mistakes.section),
        Part("random", judgement.measure, partial(judgement.section, "Random scenes"), weight=40),
        Part("cores", judgement.measure_cores, partial(judgement.section, CORES), weight=20),
        Part("variants", variants.measure, variants.section, weight=8),
        Part("paper", partial(paper_presses.measure, "default"), paper_presses.section, 12),
        Part("paper-fine", partial(paper_presses.measure, "fineness 1"), paper_presses.section, 20),
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
