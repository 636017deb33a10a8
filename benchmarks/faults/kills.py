"""Part `kills`: kill -9 of collections and of programs that use a session; full disks.

Collections are killed in chains: one session is killed, recovered and resumed several times, at
random times and in random processes, and then run to completion.
"""

import random
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.faults.collection_run import CollectionRun, Hangs, quick_bench
from benchmarks.faults.judge import UNREPORTED, complaints, judge, stored_in
from benchmarks.faults.program_kills import PROGRAMS, CannotMount, Loss, fill_disk, kill_in_turn
from benchmarks.faults.rows import Row
from benchmarks.report import Page, Run
from recorder import Session, SessionError
from rig.core.clock import SECOND_NS, SystemClock

SEED = 0
# Kills of collections, of each program, and full disks in a complete and in a quick run.
_COUNTS = ((100, 100, 20), (1, 3, 1))
# Kills of one session.
_A_SESSION = 10
# Share of the time that collections take.
_COLLECTIONS = 0.9
# Maximum time from the start of recording to the kill [s].
_LONGEST = 3.0
# A collection that lost a process has to retract, seal and end within this time [s].
_ENDING = 30.0
# What to kill, with equal probability, and the role of its process; empty: all.
VICTIMS = {
    "everything": "",
    "the collecting process": "collect",
    **{f"the {name} stream": f"{name} stream" for name in ("force", "pose", "camera")},
    "the arm's process": "arm",
    **{f"the {name} emulator": f"{name} emulator" for name in ("arm", "force", "camera")},
}
# After these the arm's emulator cannot say where it stands.
_NO_ARM = ("everything", "the collecting process", "the arm emulator")


@dataclass(slots=True)
class Kills:
    """Results of the kills of collections.

    Kills by victim; samples seen while recording, and those of them that were lost; runs that
    resumed a killed session; sessions completed in the end; and failures, in words.
    """

    victims: dict[str, int] = field(default_factory=dict)
    compared: int = 0
    lost: int = 0
    resumed: int = 0
    completed: int = 0
    wrong: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        """Number of kills."""
        return sum(self.victims.values())


def measure(run: Run) -> dict[str, Any]:
    """Kill collections and programs and fill disks; return the counts."""
    run.seeds = (SEED,)
    kills, program_kills, wanted_disks = _COUNTS[run.quick]
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
    while (least := min(programs[name] for name in PROGRAMS)) < program_kills and not wrong:
        rows += in_scratch(run.folder, lambda at: kill_in_turn(at, dice, programs), wrong)
        run.progress(_COLLECTIONS + 0.5 * (1 - _COLLECTIONS) * least / program_kills)
    try:
        for _ in range(wanted_disks):
            rows += in_scratch(run.folder, lambda at: fill_disk(at, dice), wrong)
            disks += 1
    except CannotMount as error:
        no_disk = str(error)
    run.failures += [*collections.wrong, *wrong]
    return {
        "collections": asdict(collections),
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


def kill_often(
    folder: Path,
    *,
    kills: int,
    sessions: int,
    seed: int,
    targets: int = 6,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Kills:
    """Kill `kills` times, over `sessions` sessions of `targets` targets; complete each session.

    `folder` is empty; `seed` is that of victims and times.
    """
    rng, done = random.Random(seed), Kills()
    for number in range(sessions):
        place = folder / f"chain-{number}"
        place.mkdir()
        last = done.count + (kills - done.count) // (sessions - number)
        try:
            while not _run_once(place, targets, rng if done.count < last else None, done):
                progress(done.count / kills)
        except (Hangs, LookupError, SessionError, OSError) as error:
            done.wrong.append(f"after {done.count} kills: {error}")
        shutil.rmtree(place)
    return done


def _run_once(folder: Path, targets: int, rng: random.Random | None, done: Kills) -> bool:
    """Begin or resume the session in `folder`, and kill it or let it end; return True if it has.

    `rng` chooses victim and time; None: it is not killed any more.
    """
    session = folder / "s.zarr"
    begun = session.exists()
    if begun and Session(session).status == "complete":
        wrong = complaints(session, stored_in(session).disorder)
        done.wrong += [f"resumed session: {what}" for what in wrong]
        done.completed += 1
        # If it completed between two kills, the remaining kills go to another session.
        session.rename(folder / f"done-{done.completed}.zarr")
        begun = False
        if rng is None:
            return True
    arguments = ("--resume", str(session)) if begun else ("--targets", str(targets))
    bench = quick_bench(folder, "tacpalm")
    with CollectionRun.collect(session, "--bench", str(bench), *arguments) as run:
        run.until_recording()
        # Damage by later runs can be detected in sealed rows only.
        before = _times(session)
        if rng is not None:
            done.wrong += _killed(run, rng, done)
        elif run.wait() != 0 or Session(session).status != "complete":
            raise Hangs(f"did not complete: {run.last_line}")
    after = _times(session)
    for name, times in before.items():
        if not np.array_equal(after[name][: len(times)], times):
            done.lost += 1
            done.wrong.append(f"after {done.count} kills: {name}: rows recorded before changed")
    done.resumed += begun
    return False


def _times(path: Path) -> dict[str, np.ndarray]:
    """Return t_ns of every readable row, by stream."""
    return {name: np.array(stream.t_ns) for name, stream in Session(path).streams.items()}


def _killed(run: CollectionRun, rng: random.Random, done: Kills) -> list[str]:
    """Kill one victim, check the session and recover it; return the failures."""
    clock, wait = SystemClock(), rng.uniform(0.0, _LONGEST)
    clock.sleep_until(clock.now_ns() + round(wait * SECOND_NS))
    victim = rng.choice([*VICTIMS])
    role, main = VICTIMS[victim], run.process.pid
    everybody = sorted(run.processes(), key=lambda pid: pid == main)
    run.kill(*([run.process_of(role)] if role else everybody))
    code = run.wait(_ENDING)
    wrong = [f"still runs: {process}" for process in run.left(_ENDING)]
    run.kill_all()
    row = Row("rig", victim, (code,), None, needs_recover=True, controller_gone=victim in _NO_ARM)
    result = judge(row, run, code)
    done.victims[victim] = done.victims.get(victim, 0) + 1
    done.compared += result.looked_for
    done.lost += result.lost
    # A collection that was killed reports nothing.
    wrong += [what for what in result.wrong if what != UNREPORTED]
    where = f"kill {done.count}, {victim}, {wait:.1f} s into recording"
    return [f"{where}: {what}" for what in wrong]


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
