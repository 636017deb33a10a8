"""Replay the golden set: `python tests/golden/replay.py [--slow] [--only NAME] [-j 2]`.

Prints one line per case, and the differences; exit code 1 if there are any.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cases import CASES
from golden import CHECKOUT, Case, compare, run_case

# Differences of a case that are shown without --all-lines.
MOST_LINES = 12


def replayed(case: Case, root: Path) -> tuple[list[str], str, float]:
    """Return the differences, a note on the comparison, and the duration [s].

    A real-time case that differs is tried a second time: a host that pauses for a moment does
    change the recording. The note mentions this.
    """
    began = time.monotonic()
    lines, note = _once(case, root)
    if lines and case.loose:
        first = lines[0]
        lines, note = _once(case, root)
        note += f"  (second try; the first: {first})"
    return lines, note, time.monotonic() - began


def _once(case: Case, root: Path) -> tuple[list[str], str]:
    try:
        lines, hashed = compare(case, run_case(case, root))
    except subprocess.TimeoutExpired as late:
        return [f"not done after {late.timeout:.0f} s"], ""
    except Exception as error:  # one broken case must not hide the others
        return [f"{type(error).__name__}: {error}"], ""
    return lines, "" if hashed else "  (another machine: hashes not compared)"


def all_replayed(
    cases: list[Case], root: Path, jobs: int
) -> Iterator[tuple[Case, tuple[list[str], str, float]]]:
    """Yield each case with `replayed`: real-time cases one by one, then the others in parallel."""
    for case in cases:
        if case.loose:
            yield case, replayed(case, root)
    others = [case for case in cases if not case.loose]
    with ThreadPoolExecutor(jobs) as pool:
        yield from zip(others, pool.map(lambda case: replayed(case, root), others), strict=True)


def main() -> int:
    """Replay the chosen cases and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, default=CHECKOUT, help="checkout that is run")
    parser.add_argument("--only", action="append", help="cases whose name contains this")
    parser.add_argument("--slow", action="store_true", help="the slow cases as well")
    parser.add_argument("--list", action="store_true", help="only name the cases")
    parser.add_argument("--all-lines", action="store_true", help="all that differs")
    parser.add_argument("-j", "--jobs", type=int, default=1, metavar="N", help="side by side (1)")
    options = parser.parse_args()
    chosen = [
        case
        for case in CASES
        if (options.slow or options.only or not case.slow)
        and (not options.only or any(part in case.name for part in options.only))
    ]
    if options.list:
        for case in chosen:
            print(f"{case.name}{'  (slow)' if case.slow else ''}: {len(case.commands)} commands")
        return 0
    root, began, bad = options.root.resolve(), time.monotonic(), []
    for case, (lines, note, took) in all_replayed(chosen, root, options.jobs):
        print(f"{'DIFFERS' if lines else 'same':8}{case.name:32}{took:6.1f} s{note}", flush=True)
        shown = lines if options.all_lines else lines[:MOST_LINES]
        for line in shown:
            print(f"    {line}")
        if len(lines) > len(shown):
            print(f"    and {len(lines) - len(shown)} more lines (--all-lines)")
        if lines:
            bad.append(f"{case.name} ({lines[0]})")
    print(f"{len(chosen) - len(bad)} of {len(chosen)} same, {time.monotonic() - began:.0f} s")
    if bad:
        print("differ:", *bad, sep="\n    ")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
