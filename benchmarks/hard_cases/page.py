"""Write docs/results/stability.md from the reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.hard_cases.cases import FAMILIES
from benchmarks.hard_cases.laws import escaped
from benchmarks.hard_cases.planted import WHAT
from benchmarks.hard_cases.runner import Report
from recorder.pages import render

_TITLES = {
    "material": "Material",
    "depth": "Depth",
    "edges": "Edges",
    "rim": "Rim",
    "friction": "Friction",
    "steps": "Steps and starts",
    "precision": "Precision, units, symmetry",
    "in_time": "Viscosity, inertia, gravity",
    "wrong_input": "Wrong input and no solution",
}


def page(reports: Sequence[Report], caught: Mapping[str, Sequence[Report]], device: str) -> str:
    """Return the page as Markdown; `caught` has the reports with each deliberate bug."""
    return render(
        Path(__file__).with_suffix(".md"),
        reports=reports,
        by_name={report.name: report for report in reports},
        families={_TITLES[one.__name__.rsplit(".", 1)[-1]]: one.CASES for one in FAMILIES},
        caught=caught,
        described=WHAT,
        escaped=escaped,
        device=device,
    )
