"""Hard cases for the simulator, judged by laws of mechanics.

`python -m benchmarks hard-cases`.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.options import add_device, add_seed
from sim.errors import SceneError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.hard_cases.case import Case
    from benchmarks.hard_cases.runner import Report


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Runs named cases and checks each against laws of mechanics. Exit code 1 if "
        "any law fails; with --planted, if no case detects a deliberate bug. Takes about 10 min. "
        "With --random, random scenes are judged by a referee that is independent of the solver."
    )
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="NAME",
        help="run this case only, * and ? are wildcards (may be repeated); no page is "
        "written unless --out is given",
    )
    parser.add_argument("--list", action="store_true", help="list the cases and exit")
    parser.add_argument(
        "--planted",
        metavar="MISTAKE",
        help="inject a deliberate bug into the solver and report the cases that detect it; `all`: "
        "each bug on the fastest cases that must detect it",
    )
    parser.add_argument(
        "--processes",
        type=int,
        help="number of parallel processes (default: 2 on a CPU, 1 on a GPU)",
    )
    add_device(parser)
    parser.add_argument(
        "--out",
        type=Path,
        help="page to write (default: docs/results/stability.md; with --random none)",
    )
    _add_random(parser)


def _add_random(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("random scenes, instead of the cases")
    group.add_argument(
        "--random",
        type=int,
        metavar="N",
        help="number of scenes; exit code 1 on a silently wrong answer, or on a crash",
    )
    add_seed(group)
    group.add_argument(
        "--scene", type=int, default=0, metavar="I", help="number of the first scene (%(default)s)"
    )
    group.add_argument(
        "--precision",
        choices=("auto", "float32", "float64"),
        default="auto",
        help="precision of the solver (%(default)s)",
    )
    group.add_argument(
        "--seconds", type=float, default=60.0, help="time limit of a solve (default: %(default)g)"
    )
    group.add_argument(
        "--found",
        type=Path,
        default=Path("runs/hard-cases"),
        metavar="DIR",
        help="folder for simplified failing scenes (%(default)s)",
    )
    group.add_argument("--no-shrink", action="store_true", help="do not simplify them")


def run(options: argparse.Namespace) -> int:
    """Run the cases, write the page, and return 0, or 1 if a case failed.

    Raises:
        SceneError: Unknown case, bug or device; an option out of range.
    """
    from benchmarks.hard_cases.cases import CASES, chosen
    from benchmarks.hard_cases.page import page
    from benchmarks.hard_cases.planted import MISTAKES
    from benchmarks.hard_cases.runner import run_cases
    from benchmarks.processes import INTERRUPTED
    from sim.device import ready_device

    if options.list:
        for case in CASES:
            print(f"{case.name:<38} {case.asserts}")
        return 0
    try:
        cases = chosen(options.only)
    except ValueError as error:
        raise SceneError(f"--only: {error}") from error
    mistake = options.planted
    if mistake not in (None, "all", *MISTAKES):
        raise SceneError(f"--planted: {mistake!r}; allowed: {', '.join((*MISTAKES, 'all'))}")
    processes = options.processes or (2 if options.device == "cpu" else 1)
    if processes < 1:
        raise SceneError(f"--processes: {processes}; allowed: 1 or more")
    if options.random is not None:
        return _run_random(options, processes)
    ready_device(options.device)
    if mistake == "all":
        _caught, every = _catch_all(options.device, processes)
        return 0 if every else 1
    if mistake is not None:
        return _catch(mistake, cases, options.device, processes)
    reports = run_cases(cases, device=options.device, processes=processes)
    failed = _tell(reports)
    if len(reports) < len(cases):
        return INTERRUPTED
    out = options.out or (None if options.only else Path("docs/results/stability.md"))
    if out is not None:
        print("planted mistakes:")
        caught, every = _catch_all(options.device, processes)
        out.write_text(page(reports, caught, options.device), encoding="utf-8")
        print(f"written: {out}")
        failed = failed or not every
        _tell(reports)
    return 1 if failed else 0


def _run_random(options: argparse.Namespace, processes: int) -> int:
    from benchmarks.hard_cases.random_scenes.judgement import Settings
    from benchmarks.hard_cases.random_scenes.page import page
    from benchmarks.hard_cases.random_scenes.run import RandomRun, judge_all, tell
    from benchmarks.processes import INTERRUPTED
    from sim.device import ready_device

    for name, least in (("random", 1), ("scene", 0), ("seconds", 1e-3)):
        if not getattr(options, name) >= least:
            raise SceneError(f"--{name}: {getattr(options, name)!r}; allowed: {least:g} or more")
    if options.only or options.planted == "all":
        raise SceneError("--random: with --only or --planted all; allowed: without them")
    ready_device(options.device)
    plan = RandomRun(
        options.random,
        options.seed,
        options.scene,
        Settings(options.device, options.precision, options.seconds),
        options.found,
        options.planted,
        shrinks=not options.no_shrink,
    )
    told = judge_all(plan, processes=min(processes, options.random))
    wrong = tell(told)
    if len(told) < plan.count:
        return INTERRUPTED
    if options.out is not None:
        options.out.write_text(page(told, plan), encoding="utf-8")
        print(f"written: {options.out}")
        tell(told)
    return 1 if wrong else 0


def _tell(reports: Sequence[Report]) -> bool:
    """Print the summary; return True if any case failed."""
    failed = sum(not report.passed for report in reports)
    passed = len(reports) - failed
    print(f"{len(reports)} cases, {passed} passed" + (f", {failed} failed" if failed else ""))
    return failed > 0


def _catch(mistake: str, cases: Sequence[Case], device: str, processes: int) -> int:
    from benchmarks.hard_cases.runner import run_cases

    reports = run_cases(cases, device=device, mistake=mistake, processes=processes)
    caught = [report.name for report in reports if not report.passed]
    print(f"{mistake}: {'caught by ' + ', '.join(caught) if caught else 'NOT CAUGHT'}")
    return 0 if caught else 1


def _catch_all(device: str, processes: int) -> tuple[dict[str, Sequence[Report]], bool]:
    """Run each bug on the cases that must detect it; return reports, and True if all were found."""
    from benchmarks.hard_cases.cases import BY_NAME
    from benchmarks.hard_cases.planted import DETECTING_CASES
    from benchmarks.hard_cases.runner import run_cases

    caught: dict[str, Sequence[Report]] = {}
    every = True
    for mistake, names in DETECTING_CASES.items():
        cases = [BY_NAME[name] for name in names]
        sane = run_cases(cases, device=device, processes=processes, say=_silent)
        caught[mistake] = run_cases(
            cases, device=device, mistake=mistake, processes=processes, say=_silent
        )
        seen = [
            after.name
            for before, after in zip(sane, caught[mistake], strict=True)
            if before.passed and not after.passed
        ]
        every = every and bool(seen)
        print(f"  {mistake}: {'caught by ' + ', '.join(seen) if seen else 'NOT CAUGHT'}")
    return caught, every


def _silent(_line: str) -> None:
    """Discard the line, because deliberate bugs are summarised in one line each."""
