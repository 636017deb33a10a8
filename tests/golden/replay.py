"""Replays the golden set: `python tests/golden/replay.py [--slow] [--only NAME] [-j 2]`.

Prints a line a case, and what differs; exit 1 when anything does.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cases import CASES
from golden import CHECKOUT, Case, compare, run_case

MOST_LINES = 12
"""Differences of a case that are shown without --all-lines."""


def replayed(case: Case, root: Path) -> tuple[list[str], bool, float]:
    """What differs, whether hashes were compared, and how long it took [s]."""
    began = time.monotonic()
    try:
        lines, hashed = compare(case, run_case(case, root))
    except subprocess.TimeoutExpired as late:
        lines, hashed = [f"not done after {late.timeout:.0f} s"], True
    except Exception as error:  # one broken case must not hide the others
        lines, hashed = [f"{type(error).__name__}: {error}"], True
    return lines, hashed, time.monotonic() - began


def main() -> int:
    """Replay the chosen cases; the exit code."""
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
    with ThreadPoolExecutor(options.jobs) as pool:
        results = pool.map(lambda case: replayed(case, root), chosen)
        for case, (lines, hashed, took) in zip(chosen, results, strict=True):
            note = "" if hashed else "  (another machine: hashes not compared)"
            print(
                f"{'DIFFERS' if lines else 'same':8}{case.name:32}{took:6.1f} s{note}", flush=True
            )
            shown = lines if options.all_lines else lines[:MOST_LINES]
            for line in shown:
                print(f"    {line}")
            if len(lines) > len(shown):
                print(f"    and {len(lines) - len(shown)} more lines (--all-lines)")
            if lines:
                bad.append(case.name)
    print(f"{len(chosen) - len(bad)} of {len(chosen)} same, {time.monotonic() - began:.0f} s")
    if bad:
        print(f"differ: {' '.join(bad)}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
