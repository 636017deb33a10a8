"""Part `cases`: each hard case judged by its laws."""

import time
import traceback
from fnmatch import fnmatch
from functools import partial
from typing import Any

from benchmarks.hard_cases.cases import (
    edges,
    friction,
    in_time,
    precision,
    pressing,
    steps,
    wrong_input,
)
from benchmarks.hard_cases.laws import Law
from benchmarks.hard_cases.solver import Case, Solver
from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, RED, SOFT, chart
from sim.errors import SceneError, SimulationDiverged

# Cases by name, of each family by the title of its file.
BY_FAMILY = {
    (family.__doc__ or "").split(":")[0]: {
        name.replace("_", "-"): case
        for name, case in vars(family).items()
        if isinstance(case, Case)
    }
    for family in (pressing, edges, friction, steps, precision, in_time, wrong_input)
}
CASES = {name: case for cases in BY_FAMILY.values() for name, case in cases.items()}
# At least one of each family, all together some seconds.
QUICK = (
    "poisson-0-3", "flat-punch-between-bounds", "lifted-while-it-slips", "never-touches",
    "starts-at-touch", "metres-and-millimetres", "mirror-symmetry", "inertia-of-no-mass",
    "millimetres-for-metres", "one-newton-iteration", "phases-without-time",
)  # fmt: skip

# Claim of a case, its laws, those that did not hold, and the seconds that it took.
Report = dict[str, Any]


def chosen(patterns: list[str]) -> list[str]:
    """Return names that match a pattern (`*`, `?`), or all; SceneError if a pattern has none."""
    for pattern in patterns:
        if not any(fnmatch(name, pattern) for name in CASES):
            allowed = ", ".join(CASES)
            raise SceneError(f"--case: no case is called {pattern!r}; allowed: {allowed}")
    return [name for name in CASES if any(fnmatch(name, each) for each in patterns or ["*"])]


def judge(solver: Solver, name: str) -> Report:
    """Run a case in this process; any exception counts as its failure and affects no other."""
    began = time.perf_counter()
    case = CASES[name]
    laws: list[Law] = []
    try:
        laws = list(case.laws(solver))
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
        "asserts": case.says,
        "laws": [[law.says, law.measured, law.sense, law.limit, law.used] for law in laws],
        "failures": failures,
        "seconds": round(time.perf_counter() - began, 1),
    }


def measure(run: Run) -> dict[str, Report]:
    """Run the cases."""
    names = chosen(run.options.case or (list(QUICK) if run.quick else []))
    reports = rows_of(run, partial(judge, Solver(run.device)), {name: name for name in names})
    for name, report in reports.items():
        run.failures += [f"{name}: {failure}" for failure in report["failures"]]
    return reports


def section(reports: dict[str, Report], page: Page) -> str:
    """Return the table of the families, and the laws that do not hold."""
    by_family = {
        family: {name: reports[name] for name in cases if name in reports}
        for family, cases in BY_FAMILY.items()
        if cases.keys() & reports.keys()
    }
    _draw(by_family, page)
    rows = []
    for family, some in by_family.items():
        laws = [(*law, name) for name, report in some.items() for law in report["laws"]]
        inexact = [law for law in laws if law[1] != law[3]]
        words = "none"
        if inexact:
            *law, used, name = max(inexact, key=lambda law: law[4])
            words = f"{escaped(str(Law(*law)))}, {100 * used:.0f} % used (`{name}`)"
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
        "of 1 mm, coarse for force, but the laws must hold there as well. Used: of the allowance."
    )
    picture = page.link(
        "laws", "Each law of each case: the part of its allowance that it uses, at the bottom none"
    )
    not_held = "\n".join(["Not held:", "", *failures]) if failures else "All laws hold."
    return "\n\n".join([text, picture, table(columns, rows), not_held])


def escaped(text: str) -> str:
    """Return the text for a cell of a Markdown table."""
    return text.replace("<", "&lt;").replace("|", "\\|")


def _draw(by_family: dict[str, dict[str, Report]], page: Page) -> None:
    """Draw each law of each case as a point: the part of its allowance that it uses."""
    least, first, middles = 1e-4, 0, []
    with chart(page.picture("laws"), 9, 3.2) as figure:
        axes = figure.subplots()
        for some in by_family.values():
            for number, report in enumerate(some.values(), start=first):
                used = [max(law[4], least) for law in report["laws"]]
                color = [BLUE if each <= 1 else RED for each in used]
                axes.scatter([number] * len(used), used, s=8, c=color)
            middles.append(first + (len(some) - 1) / 2)
            first += len(some)
            axes.axvline(first - 0.5, color=SOFT, linewidth=0.8)
        axes.axhline(1, color=RED, linewidth=1)
        axes.set(yscale="log", ylabel="part of the allowance used", xlim=(-0.5, first - 0.5))
        axes.set_title("Laws of the cases; above the line at 1 a law fails")
        axes.set_xticks(middles, [name.replace(" and ", "\nand ") for name in by_family])
        axes.tick_params(axis="x", length=0, grid_alpha=0)
