"""Part `cases`: each hard case judged by its laws."""

from __future__ import annotations

import time
import traceback
from collections.abc import Sequence
from functools import partial
from typing import Any

from benchmarks.hard_cases.cases import BY_FAMILY, CASES, LONGEST, QUICK, asserts, chosen
from benchmarks.hard_cases.laws import Law
from benchmarks.hard_cases.solver import Case, Solver
from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from sim.errors import SimulationDiverged

# A case's laws, the seconds that it took, and what did not hold.
Report = dict[str, Any]


def judge(case: Case, solver: Solver) -> Report:
    """Run one case in this process; any exception counts as its failure and affects no other."""
    began = time.perf_counter()
    laws: list[Law] = []
    failures = []
    try:
        laws = case(solver)
        failures = [str(law) for law in laws if not law.holds]
        if not laws:
            failures = ["no law was measured"]
    except SimulationDiverged as diverged:
        diverged.forget_dump()
        failures = [f"no converged state: {str(diverged).split('; state: ')[0]}"]
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        failures = [f"{type(error).__name__}: {error} ({last.filename}:{last.lineno})"]
    return {
        "laws": [[law.says, law.measured, law.sense, law.limit, law.used] for law in laws],
        "failures": failures,
        "seconds": round(time.perf_counter() - began, 1),
    }


def judge_named(device: str, name: str) -> Report:
    """Judge the solver by the case of this name."""
    return {"asserts": asserts(CASES[name])} | judge(CASES[name], Solver(device))


def measure(run: Run) -> dict[str, Report]:
    """Run the cases."""
    names = list(QUICK) if run.quick else chosen(run.options.case)
    order = sorted(names, key=lambda name: name not in LONGEST)
    reports = rows_of(run, partial(judge_named, run.device), {name: name for name in order})
    for name, report in reports.items():
        run.failures += [f"{name}: {failure}" for failure in report["failures"]]
    return {name: reports[name] for name in names}


def section(reports: dict[str, Report], page: Page) -> str:
    """Return the table of the families, and the laws that do not hold."""
    by_family = {
        family: some
        for family, cases in BY_FAMILY.items()
        if (some := {name: reports[name] for name in cases if name in reports})
    }
    _draw(by_family, page)
    rows = []
    for family, some in by_family.items():
        laws = [(*law, name) for name, report in some.items() for law in report["laws"]]
        inexact = [law for law in laws if law[1] != law[3]]
        nearest = max(inexact, key=lambda law: law[4], default=None)
        words = "none" if nearest is None else f"{_law(nearest)} (`{nearest[5]}`)"
        passed = sum(not report["failures"] for report in some.values())
        seconds = sum(report["seconds"] for report in some.values())
        rows.append([family, len(some), passed, len(laws), words, f"{seconds:.0f}"])
    columns = ["family", "cases", "passed", "laws", "law nearest to its limit", "s"]
    failures = [
        f"- `{name}`: {escaped(failure)}"
        for name, report in reports.items()
        for failure in report["failures"]
    ]
    text = (
        "## Cases\n\nScenes that break simulators. A case is judged by laws of mechanics alone: no "
        "element inverts, base and indenter balance, no work is created, symmetric scenes have "
        "symmetric results, neither steps nor units nor precision affect the result, and no "
        "contact point exceeds Coulomb's limit. A state that did not converge is never accepted: "
        "`SimulationDiverged` lists its attempts and stores the last converged state. Limits are "
        "explained where they are used, in `benchmarks/hard_cases/cases`: the accuracy expected "
        "of the mesh, the tolerance or float32, and a factor of 2 to 5. Most cases use elements "
        "of 1 mm, coarse for force, but the laws must hold there as well."
    )
    picture = page.link(
        "laws", "Each law of each case: the part of its allowance that it uses, at the bottom none"
    )
    not_held = "\n".join(["Not held:", "", *failures]) if failures else "All laws hold."
    return "\n\n".join([text, picture, table(columns, rows), not_held])


def _law(law: Sequence[Any]) -> str:
    says, measured, sense, limit = law[:4]
    return escaped(f"{says}: {measured:.3g} {'≤' if sense == '<=' else '≥'} {limit:.3g}")


def escaped(text: str) -> str:
    """Return the text for a cell of a Markdown table."""
    return text.replace("<", "&lt;").replace("|", "\\|")


def _draw(by_family: dict[str, dict[str, Report]], page: Page) -> None:
    """Draw each law of each case as a point: the part of its allowance that it uses."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(9, 3.2), layout="constrained")
    least, first, middles = 1e-4, 0, []
    for some in by_family.values():
        for number, report in enumerate(some.values(), start=first):
            used = [max(law[4], least) for law in report["laws"]]
            color = ["tab:blue" if each <= 1 else "tab:red" for each in used]
            axes.scatter([number] * len(used), used, s=8, c=color)
        middles.append(first + (len(some) - 1) / 2)
        first += len(some)
        axes.axvline(first - 0.5, color="0.85", linewidth=0.8)
    axes.axhline(1, color="tab:red", linewidth=1)
    axes.set(yscale="log", ylabel="part of the allowance used", xlim=(-0.5, first - 0.5))
    axes.set_xticks(middles, [name.replace(" and ", "\nand ") for name in by_family], fontsize=8)
    axes.tick_params(axis="x", length=0)
    figure.savefig(page.picture("laws"), dpi=150)
    pyplot.close(figure)
