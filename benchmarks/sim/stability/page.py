"""Write docs/results/stability.md from the reports."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence

from benchmarks.sim.stability.catalogue import BY_NAME, FAMILIES
from benchmarks.sim.stability.laws import Law, escaped
from benchmarks.sim.stability.planted import WHAT
from benchmarks.sim.stability.runner import Report

_INTRO = """# Stability

Scenes that break simulators, and the results of the finite-element solver. A case is judged by laws
of mechanics alone: no element inverts, base and indenter balance, no work is created, symmetric
scenes have symmetric results, neither steps nor units nor precision affect the result, and no
contact point exceeds Coulomb's limit. A state that did not converge is never accepted: the solver
raises `SimulationDiverged` with its attempts and its last converged state.

Repeat it with `make hard-cases` (`ONLY=name` for some; `python -m benchmarks hard-cases --list`
lists them). It fails if any law fails. Each limit is explained in `benchmarks/sim/stability/`: the
accuracy expected of the mesh, the tolerance or float32, and a factor of 2 to 5. Most cases use
elements of 1 mm (20 x 20 x 4 in the gel), which is coarse for force, but the laws must hold there
as well.
"""

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
    passed = sum(report.passed for report in reports)
    seconds = sum(report.seconds for report in reports)
    machine = f"{platform.machine()}, {os.cpu_count()} cores, device {device}"
    lines = [
        _INTRO,
        f"{len(reports)} cases, {passed} passed; {seconds / 60:.1f} minutes of one process "
        f"({machine}).",
    ]
    by_name = {report.name: report for report in reports}
    for family in FAMILIES:
        rows = [by_name[case.name] for case in family.CASES if case.name in by_name]
        if rows:
            title = _TITLES[family.__name__.rsplit(".", 1)[-1]]
            lines += ["", f"## {title}", ""]
            lines += ["| case | asserts | measured, limit | s |", "|---|---|---|---|"]
            lines += [_row(report) for report in rows]
    if caught:
        lines += ["", *_planted(caught)]
    return "\n".join(lines) + "\n"


def _row(report: Report) -> str:
    name = f"`{report.name}`" if report.passed else f"**FAILED** `{report.name}`"
    laws = "<br>".join(_cell(law) for law in report.laws) or escaped(report.trouble)
    asserts = escaped(BY_NAME[report.name].asserts)
    return f"| {name} | {asserts} | {laws} | {report.seconds:.1f} |"


def _cell(law: Law) -> str:
    text = escaped(str(law))
    return text if law.holds else f"**{text}**"


def _planted(caught: Mapping[str, Sequence[Report]]) -> list[str]:
    lines = [
        "## Deliberate bugs",
        "",
        "Deliberate bugs can be injected into the solver (`--planted NAME`, or `all`). The cases "
        "must detect each; these are the fastest that do, with the law that fails.",
        "",
        "| bug | description | detected by | law that fails |",
        "|---|---|---|---|",
    ]
    for mistake, reports in caught.items():
        failing = [report for report in reports if not report.passed]
        names = "<br>".join(f"`{report.name}`" for report in failing) or "**not detected**"
        laws = "<br>".join(escaped(report.failures[0]) for report in failing)
        lines.append(f"| {mistake} | {WHAT[mistake]} | {names} | {laws} |")
    return lines
