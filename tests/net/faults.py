"""Ends of the rows of `benchmarks faults`, compared between two of its pages.

`python tests/net/faults.py PAGE` prints the rows of a page as JSON, and `--against faults.json` the
rows that end otherwise, with exit code 1. `faults.json` is of the commit c69dc120.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path

# What must not change of a row: the exit code, where the arm ended, what was lost.
KEPT = ("exit", "lost", "arm")


def rows_of(page: str) -> dict[str, dict[str, str]]:
    """Return what must not change of each row of a page, by its device and fault."""
    rows: dict[str, dict[str, str]] = {}
    device, names = "", []
    for line in page.splitlines():
        if line.startswith("## "):
            device = line[3:]
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| fault"):
            names = cells
        elif line.startswith("| ") and len(cells) == len(names) and not line.startswith("|--"):
            row = dict(zip(names, cells, strict=True))
            kept = {key: row[key] for key in KEPT if key in row}
            # Depth at which it stands, and samples that were looked for, vary from run to run.
            kept = {key: re.sub(r"at -?[\d.]+ mm", "in contact", kept[key]) for key in kept}
            rows[f"{device}: {cells[0]}"] = {
                key: re.sub(r"(\d+) of \d+", r"\1", value) for key, value in kept.items()
            }
    return rows


def main() -> int:
    """Print the rows of a page, or those that differ, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=Path, help="page that python -m benchmarks faults wrote")
    parser.add_argument("--against", type=Path, help="rows to compare with")
    options = parser.parse_args()
    rows = rows_of(options.page.read_text())
    if options.against is None:
        print(json.dumps(rows, indent=1))
        return 0
    before = json.loads(options.against.read_text())
    differing = [name for name in before if rows.get(name) != before[name]]
    for name in differing:
        print(f"{name}: {before[name]}, now {rows.get(name)}")
    print(f"{len(before) - len(differing)} of {len(before)} rows end alike")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
