"""`python -m benchmarks faults`: faults of devices, values and bench files, kills, endurance."""

import argparse
from typing import Any

from benchmarks.faults import device_faults, endurance, kills, plausibility, wrong_benches
from benchmarks.processes import add_processes
from benchmarks.report import Benchmark, Part
from recorder.command_line.options import add_seed
from recorder.processes import cores


def _options(parser: argparse.ArgumentParser) -> None:
    add_processes(parser, default=cores())
    add_seed(parser)


def _summary(values: dict[str, Any]) -> str:
    lines = []
    if rows := values.get("faults", {}).get("rows"):
        passed = sum(not row["wrong"] for row in rows)
        looked_for, lost = (sum(row[key] for row in rows) for key in ("looked_for", "lost"))
        lines.append(
            f"{passed} of {len(rows)} faults ended as they must; {lost} of {looked_for:,} "
            "accepted samples were lost."
        )
        lines += [
            f"- {row['device']} {row['fault']}: {what}" for row in rows for what in row["wrong"]
        ]
    if killed := values.get("kills"):
        collections, programs = killed["collections"], killed["programs"]
        count = sum(collections["victims"].values()) + sum(programs["kills"].values())
        wrong = [*collections["wrong"], *programs["wrong"]]
        lines.append(f"{count} kills and {killed['disks']} full disks: {len(wrong)} failures.")
        lines += [f"- {what}" for what in wrong]
    return "\n\n".join(lines)


BENCHMARK = Benchmark(
    "faults",
    "Faults, kills, wrong benches, endurance",
    "What does the rig lose or break when devices fail, processes are killed, disks fill up, the "
    "bench file is wrong, or it runs for long? On mock benches, in real time.",
    (
        Part("faults", device_faults.measure, device_faults.section, weight=10.0),
        Part("kills", kills.measure, kills.section, weight=20.0),
        Part("no-gauge", wrong_benches.measure, wrong_benches.section, weight=10.0),
        Part("healthy", plausibility.measure_healthy, plausibility.section_healthy, weight=60.0),
        Part("edits", plausibility.measure_edits, plausibility.section_edits, weight=10.0),
        Part("endurance", endurance.measure, endurance.section, weight=30.0),
    ),
    summary=_summary,
    options=_options,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
