"""`tactile session list`: list the sessions below a folder, and search them."""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from datetime import date
from pathlib import Path

from recorder.catalogue import UNREADABLE, Catalogue, Query, Row
from recorder.command_line.options import reads
from recorder.command_line.terminal import State, table

# As `recorder.spec.STATUSES`, which would import NumPy.
_STATUSES = ("recording", "complete", "stopped", "recovered", UNREADABLE)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add = parser.add_argument
    about = "folder of sessions, searched with its subfolders (%(default)s)"
    add("folder", type=Path, nargs="?", default=Path("sessions"), help=about)
    add("--sensor", default="", metavar="NAME", help="only sessions of this sensor")
    add("--indenter", default="", metavar="NAME", help="only sessions with this indenter")
    add("--plan", default="", metavar="KIND", help="press_shear or force_depth")
    add("--status", default="", choices=_STATUSES, help="only this status")
    day = reads(date.fromisoformat, "a day such as 2026-11-24")
    add("--since", type=day, metavar="DATE", help="first day, such as 2026-11-24 (UTC)")
    add("--until", type=day, metavar="DATE", help="last day, included (UTC)")
    faults = parser.add_mutually_exclusive_group()
    about = "only sessions that are not complete, dropped samples or failed their last check"
    faults.add_argument("--faults", action="store_true", default=None, help=about)
    faults.add_argument(
        "--no-faults", action="store_false", dest="faults", help="only sessions without faults"
    )
    about = "check the listed sessions that were not checked since they changed; may take long"
    add("--check", action="store_true", help=about)
    add("--json", action="store_true", help="print one JSON object per session")


def run(options: argparse.Namespace) -> int:
    """Print the sessions that meet all conditions; return the exit code."""
    catalogue = Catalogue(options.folder)
    catalogue.refresh()
    query = Query(
        sensor=options.sensor,
        indenter=options.indenter,
        plan=options.plan,
        status=options.status,
        since=options.since,
        until=options.until,
        faults=None if options.check else options.faults,
    )
    rows = catalogue.find(query)
    if options.check:
        rows = _checked(catalogue, rows)
        if options.faults is not None:
            rows = [row for row in rows if bool(row.faults) == options.faults]
    if options.json:
        for row in rows:
            print(json.dumps({**asdict(row), "faults": row.faults}))
        return 0
    for line in _table(rows, catalogue.folder):
        print(line)
    faulty = sum(bool(row.faults) for row in rows)
    unchecked = sum(row.findings is None for row in rows)
    print(
        f"{len(rows)} of {len(list(catalogue))} sessions, {faulty} with faults, "
        f"{unchecked} not checked"
    )
    return 0


def _checked(catalogue: Catalogue, rows: list[Row]) -> list[Row]:
    """Return the rows with the findings of a check, made now where there is none yet."""
    from recorder.checks.check import check
    from recorder.errors import SessionError
    from recorder.findings import faults

    checked = []
    for row in rows:
        if row.findings is None and row.status != UNREADABLE:
            try:
                findings = check(catalogue.folder / row.path)
                codes = {finding.code for finding in faults(findings)}
            except SessionError:
                codes = {"metadata"}
            row = catalogue.record_check(row, codes)
            catalogue.save()
        checked.append(row)
    return checked


def _table(rows: list[Row], folder: Path) -> list[str]:
    columns: dict[str, Sequence[object]] = {
        "started (UTC)": [row.started_utc[:16].replace("T", " ") for row in rows],
        "sensor": [row.sensor for row in rows],
        "indenter": [row.indenter for row in rows],
        "plan": [row.plan for row in rows],
        "targets": [
            row.targets or "" if row.done is None else f"{row.done}/{row.targets}" for row in rows
        ],
        "runs": [row.runs or "" for row in rows],
        "mock": ["mock" if row.mock else "" for row in rows],
        "status": [row.status for row in rows],
        "faults": [
            ", ".join(fault for fault in row.faults if fault != row.status)
            or ("not checked" if row.findings is None else "none")
            for row in rows
        ],
        "path": [folder / row.path for row in rows],
    }
    # The name of a path has the sensor, the indenter and the time, unless it was chosen.
    spare = ("runs", "plan", "started (UTC)", "sensor", "indenter", "mock")
    states: list[State] = ["fault" if row.faults else "" for row in rows]
    return table(columns, spare=spare, states=states, complete="| less -S, or --json")
