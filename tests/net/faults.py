"""Ends of the rows of `benchmarks faults`, compared with those recorded.

`python tests/net/faults.py JSON` prints the rows of a run, and `--against faults.json` those that
end otherwise, with exit code 1; `--some` compares only the rows that were run.
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import Any


def rows_of(stored: dict[str, Any]) -> dict[str, dict[str, str]]:
    """Return what must not change of each row of a run, by its device and fault."""
    return {
        f"{row['device'][0].upper()}{row['device'][1:]}: {row['fault']}": {
            "exit": str(row["exit"]),
            "lost": str(row["lost"]),
            # The depth at which it stands varies from run to run.
            "arm": re.sub(r"at -?[\d.]+ mm", "in contact", row["arm"]),
        }
        for row in stored["faults"]["results"]["rows"]
    }


def main() -> int:
    """Print the rows of a run, or those that differ, and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("json", type=Path, help="JSON file that python -m benchmarks faults wrote")
    parser.add_argument("--against", type=Path, help="rows to compare with")
    parser.add_argument("--some", action="store_true", help="compare only the rows that were run")
    options = parser.parse_args()
    rows = rows_of(json.loads(options.json.read_text()))
    if options.against is None:
        print(json.dumps(rows, indent=1))
        return 0
    before = json.loads(options.against.read_text())
    if options.some:
        before = {name: before.get(name) for name in rows}
    differing = [name for name in before if rows.get(name) != before[name]]
    for name in differing:
        print(f"{name}: {before[name]}, now {rows.get(name)}")
    print(f"{len(before) - len(differing)} of {len(before)} rows end alike")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
