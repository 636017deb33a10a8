"""Record the results of a checkout: `python tests/golden/record.py --root CHECKOUT [--only NAME]`.

Every case runs twice; results that differ between the runs are dropped and reported.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from cases import CASES
from golden import CHECKOUT, EXPECTED, agreed, as_text, machine, record_path, run_case


def main() -> int:
    """Record the chosen cases and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=Path, default=CHECKOUT, help="checkout that is run")
    parser.add_argument("--only", action="append", help="cases whose name contains this")
    parser.add_argument("--missing", action="store_true", help="only what has no record yet")
    options = parser.parse_args()
    EXPECTED.mkdir(exist_ok=True)
    for case in CASES:
        if options.only and not any(part in case.name for part in options.only):
            continue
        if options.missing and record_path(case).exists():
            continue
        began = time.monotonic()
        try:
            one = run_case(case, options.root.resolve())
            took = time.monotonic() - began
            other = one if case.once else run_case(case, options.root.resolve())
        except Exception as error:  # one broken case must not stop the others
            print(f"{case.name}: NOT RECORDED, {type(error).__name__}: {error}", flush=True)
            continue
        dropped: list[str] = []
        record = {"machine": machine(), "found": agreed(one, other, dropped=dropped)}
        text = as_text(record)
        record_path(case).write_text(text)
        codes = [each["exit"] for each in one["commands"]]
        print(f"{case.name}: {took:.1f} s, exit {codes}, {len(text)} bytes", flush=True)
        for line in dropped:
            print(f"  not kept: {line}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
