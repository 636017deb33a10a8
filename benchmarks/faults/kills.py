"""Part `kills`: kill -9 of collections and of programs that use a session; full disks."""

from __future__ import annotations

import random
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from benchmarks.faults.collection_kills import kill_often
from benchmarks.faults.disk import CannotMount
from benchmarks.faults.program_kills import PROGRAMS, Loss, fill_disk, kill_in_turn
from benchmarks.report import Page, Run
from recorder import SessionError

SEED = 0
# Kills of collections in a complete and in a quick run; sessions have ten each.
KILLS, QUICK_KILLS, _A_SESSION = 100, 1, 10
# Kills of each program, and full disks.
_PROGRAM_KILLS, _DISKS = (100, 3), (20, 1)
# Share of the time that collections take.
_COLLECTIONS = 0.9


def measure(run: Run) -> dict[str, Any]:
    """Kill collections and programs and fill disks; return the counts."""
    run.seeds = (SEED,)
    kills = run.options.kills
    if kills is None:
        kills = QUICK_KILLS if run.quick else KILLS
    collections = kill_often(
        run.folder,
        kills=kills,
        sessions=-(-kills // _A_SESSION),
        seed=SEED,
        targets=2 if run.quick else 6,
        progress=lambda fraction: run.progress(_COLLECTIONS * fraction),
    )
    programs: Counter[str] = Counter()
    dice, wrong, rows, disks, no_disk = random.Random(SEED), list[str](), 0, 0, ""
    wanted_kills, wanted_disks = _PROGRAM_KILLS[run.quick], _DISKS[run.quick]
    while (least := min(programs[name] for name in PROGRAMS)) < wanted_kills and not wrong:
        rows += in_scratch(run.folder, lambda at: kill_in_turn(at, dice, programs), wrong)
        run.progress(_COLLECTIONS + 0.5 * (1 - _COLLECTIONS) * least / wanted_kills)
    try:
        for _ in range(wanted_disks):
            rows += in_scratch(run.folder, lambda at: fill_disk(at, dice), wrong)
            disks += 1
    except CannotMount as error:
        no_disk = str(error)
    run.failures += [*collections.wrong, *wrong]
    return {
        # asdict makes keys of its items of a Counter.
        "collections": asdict(replace(collections, victims=Counter()))
        | {"victims": collections.victims},
        "programs": {"kills": programs, "rows": rows, "wrong": wrong},
        "disks": disks,
        "no_disk": no_disk,
    }


def in_scratch(folder: Path, act: Callable[[Path], int], wrong: list[str]) -> int:
    """Call `act` with an empty folder and return the rows it looked for; note the losses."""
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        try:
            return act(Path(scratch))
        except (SessionError, Loss) as error:
            wrong.append(str(error))
            return 0


def section(values: dict[str, Any], page: Page) -> str:
    """Return the counts of both kinds of kills, and of full disks."""
    collections, programs = values["collections"], values["programs"]
    killed = ", ".join(f"{victim} {count}" for victim, count in collections["victims"].items())
    by_program = ", ".join(f"{name} {count}" for name, count in programs["kills"].items())
    disks = f"{values['disks']} disks were filled by writing"
    if values["no_disk"]:
        disks = f"Full disks were not tested (a tmpfs needs root: {values['no_disk']})"
    return f"""## Kills and full disks

SIGKILL to a random process of a mock collection within the first 3 s of recording, repeatedly in
the same sessions: killed, recovered (`tactile session recover`), resumed, killed again, and finally
run to `complete`. The rows of earlier runs are compared after each recovery and each resume, and no
process may outlive its collection. Killed: {killed}. Of {collections["compared"]:,} samples that
collections had accepted, **{collections["lost"]}** were lost; {collections["completed"]} sessions,
resumed {collections["resumed"]} times, reached `complete`.

Programs that write, recover and resume a session as fast as they can were killed within 0.25 s:
{by_program}. {disks}. {programs["rows"]:,} accepted rows were compared;
{len(programs["wrong"])} trials lost, doubled or changed a row, or left a session that `tactile
session check` finds damaged."""
