"""`python -m benchmarks recording`: what recording costs and loses, and how fast it is read."""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from importlib import import_module
from typing import Any

from benchmarks.report import Benchmark, Part, table

# Largest time to append a frame (p99) [ms], and share of a core of all streams at once.
APPEND_MS, CORE = 5.0, 0.60
# Least rate of random windows of JPEG, relative to MCAP's.
OF_MCAP = 1.5


def _part(name: str, module: str, weight: float, needs: str = "") -> Part:
    """Return a part whose module is imported when it is used."""

    def of(function: str) -> Callable[..., Any]:
        return getattr(import_module(f"benchmarks.recording.{module}"), function)  # type: ignore[no-any-return]

    return Part(
        name,
        lambda run: of("measure")(run),
        lambda values, page: str(of("section")(values, page)),
        weight,
        needs,
    )


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--repeats", type=int, default=5, help="of each store (%(default)s)")
    parser.add_argument(
        "--targets", type=int, default=8, help="collected on the mock bench (%(default)s)"
    )
    parser.epilog = "The disk that is measured is that of TMPDIR; it needs about 16 GB."


def summary(results: dict[str, Any]) -> str:
    """Return the goals that the measurements decide, and whether they are reached."""
    of_part: dict[str, Callable[[Any], list[list[object]]]] = {
        "stores": _of_stores,
        "load": _of_load,
        "alignment": _of_alignment,
    }
    lines = [
        line for name, goals in of_part.items() if name in results for line in goals(results[name])
    ]
    if not lines:
        return ""
    rows = [[goal, measured, "yes" if reached else "**no**"] for goal, measured, reached in lines]
    return table(["goal", "measured", "reached"], rows)


def _of_stores(rows: list[dict[str, Any]]) -> list[list[object]]:
    from benchmarks.recording import comparison
    from benchmarks.recording.stores import MCAP, OURS

    known = {row["key"]: row for row in rows if row["written"]}
    lines: list[list[object]] = []
    kills = [one for key, row in known.items() if key.startswith("ours") for one in row["kills"]]
    if kills:
        lost, wrong = max(one["lost"] for one in kills), sum(one["wrong"] for one in kills)
        figures = f"{lost} lost at most, {wrong} invented, in {len(kills)} kills"
        lines.append(
            ["kill -9: at most 1 frame lost, none invented", figures, lost <= 1 and not wrong]
        )
    if {OURS, MCAP} <= known.keys():
        for what, goal, least in (
            ("written", "JPEG is written at least as fast as by MCAP's default", 1.0),
            ("read", f"random windows of JPEG at {OF_MCAP:g} of MCAP's rate or more", OF_MCAP),
        ):
            for by, name in (("cpu", "per CPU-second"), ("seconds", "by the clock")):
                ratio = statistics.median(comparison.ratios(rows, what, by))
                lines.append([f"{goal}, {name}", f"{ratio:.2f}", ratio >= least])
    others = [
        comparison.rate(row, "written", "cpu")
        for key, row in known.items()
        if comparison.survives(row) and not key.startswith("ours") and not key.endswith("jpeg")
    ]
    if "ours-zstd" in known and others:
        ours = comparison.rate(known["ours-zstd"], "written", "cpu")
        figures = f"{ours:,.0f} frames per CPU-second; the next {max(others):,.0f}"
        lines.append(
            ["lossless: the fastest store that survives a kill", figures, ours > max(others)]
        )
    return lines


def _of_load(values: dict[str, Any]) -> list[list[object]]:
    fed = values["together"]
    dropped = sum(one["dropped"] + bool(one["failure"]) for one in fed)
    p99 = max(one["append_ms"]["p99"] for one in fed)
    cores = sum(one["cpu"] for one in fed)
    what = "two lossless cameras, force 1 kHz, pose 500 Hz, taxels"
    return [
        [f"{what}: nothing dropped", f"{dropped} dropped", not dropped],
        [f"the same: append p99 below {APPEND_MS:g} ms", f"{p99:.2f} ms", p99 < APPEND_MS],
        [f"the same: below {100 * CORE:.0f} % of a core", f"{100 * cores:.0f} %", cores < CORE],
    ]


def _of_alignment(values: dict[str, Any]) -> list[list[object]]:
    from benchmarks.recording.alignment import DEFAULTS, errors_by_method

    lines: list[list[object]] = []
    for stream, (name, unit) in DEFAULTS.items():
        errors = errors_by_method(values["methods"], stream, unit)
        best = min(errors, key=lambda method: errors[method])
        figures = f"{errors[name]:.3g} {unit} rms; best: {best}, {errors[best]:.3g} {unit}"
        goal = f"the default for {stream} (`{name}`) is as accurate as any"
        lines.append([goal, figures, errors[name] <= 1.05 * errors[best]])
    return lines


BENCHMARK = Benchmark(
    name="recording",
    title="Recording",
    question=(
        "What does recording cost beside other stores, what is lost when a writer is killed, how "
        "many streams can a machine keep, how well do labels fit their images, and how fast are "
        "windows and forces read?"
    ),
    parts=(
        _part("stores", "comparison", 8, "the extra bench"),
        _part("load", "load", 6),
        _part("lateness", "lateness", 1.5),
        _part("alignment", "alignment", 0.5),
        _part("bench", "bench_session", 1),
        _part("loading", "loading", 1, "the extra learn; LeRobot in the Python of LEROBOT_PYTHON"),
        _part("latency", "latency", 1, "the extra learn"),
    ),
    summary=summary,
    options=_options,
)
add_arguments = BENCHMARK.add_arguments
run = BENCHMARK.run
