"""Kill random processes of a collection at random times, recover each time, complete the session.

Each chain is one session that is killed, recovered and resumed several times and then run to
completion.
"""

from __future__ import annotations

import random
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.faults.collection_run import EMULATORS, CollectionRun, Hangs, quick_bench
from benchmarks.faults.device_faults import UNREPORTED, judge
from benchmarks.faults.judge import complaints, stored_in
from benchmarks.faults.processes import kill, wait_gone
from benchmarks.faults.rows import Row
from recorder import Session, SessionError
from rig.core.clock import SECOND_NS, SystemClock

_SENSOR = "tacpalm"
_STREAMS = ("force", "pose", "camera")
# Processes to kill, with equal probability.
VICTIMS = (
    "everything",
    "the collecting process",
    *(f"the {name} stream" for name in _STREAMS),
    "the arm's process",
    *(f"the {name} emulator" for name in ("arm", "force", "camera")),
)
# After these the arm's emulator cannot say where it stands.
_NO_ARM = (*VICTIMS[:2], "the arm emulator")
# Maximum time from the start of recording to the kill [s].
_LONGEST = 3.0
# A collection that lost a process has to retract, seal and end within this time [s].
_ENDING = 30.0
_WHOLE = 240.0


@dataclass(slots=True)
class Kills:
    """Results of the kills."""

    victims: Counter[str] = field(default_factory=Counter)
    """Number of kills by victim."""
    compared: int = 0
    """Number of samples seen while recording that were looked for."""
    lost: int = 0
    """Number of those that were missing."""
    resumed: int = 0
    """Number of runs that resumed a killed session."""
    completed: int = 0
    """Number of sessions that were completed afterwards."""
    wrong: list[str] = field(default_factory=list)
    """Failures."""


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
        wanted = (kills - done.victims.total()) // (sessions - number)
        try:
            _chain(
                place, wanted, targets, rng, done, lambda: progress(done.victims.total() / kills)
            )
        except (Hangs, LookupError, SessionError, OSError) as error:
            done.wrong.append(f"after {done.victims.total()} kills: {error}")
        shutil.rmtree(place)
    return done


def _chain(
    folder: Path,
    kills: int,
    targets: int,
    rng: random.Random,
    done: Kills,
    killed: Callable[[], None],
) -> None:
    bench, session = quick_bench(folder, _SENSOR), folder / "s.zarr"
    for _ in range(kills):
        if session.exists() and Session(session).status == "complete":
            # It completed between two kills, so the remaining kills go to another session.
            session.rename(folder / f"done-{done.completed}.zarr")
            done.completed += 1
        begun = session.exists()
        arguments = ("--resume", str(session)) if begun else ("--targets", str(targets))
        with CollectionRun(session, "--bench", str(bench), *arguments) as collection:
            _kill_once(collection, rng, done)
        done.resumed += begun
        killed()
    if Session(session).status != "complete":
        _complete(session, bench, done)
    stored = stored_in(session)
    done.wrong += [f"resumed session: {what}" for what in complaints(session, stored.disorder)]
    done.completed += stored.status == "complete"
    if stored.status != "complete":
        done.wrong.append(f"resumed session: status {stored.status}; right: complete")


def _kill_once(collection: CollectionRun, rng: random.Random, done: Kills) -> None:
    """Kill one victim, check the session and recover it."""
    collection.until_recording()
    # Damage by later runs can be detected in sealed rows only.
    before, clock = _times(collection.session), SystemClock()
    wait = rng.uniform(0.0, _LONGEST)
    clock.sleep_until(clock.now_ns() + round(wait * SECOND_NS))
    victim, everybody = rng.choice(VICTIMS), collection.processes()
    collection.kill(*_pids(collection, victim))
    code = collection.wait(_ENDING)
    left = wait_gone(everybody, _ENDING)
    kill(left)
    if collection.folder is not None:
        shutil.rmtree(collection.folder, ignore_errors=True)
    row = Row("rig", victim, (code,), None, needs_recover=True, controller_gone=victim in _NO_ARM)
    result = judge(row, collection, code)
    changed = _changed(before, collection.session)
    done.victims[victim] += 1
    done.compared += result.looked_for
    done.lost += result.lost + len(changed)
    wrong = [f"still runs: {everybody[pid].strip()[-60:]}" for pid in left]
    wrong += [f"{name}: rows recorded before changed" for name in changed]
    # A collection that was killed reports nothing.
    wrong += [what for what in result.wrong if what != UNREPORTED]
    where = f"kill {done.victims.total()}, {victim}, {wait:.1f} s into recording"
    done.wrong += [f"{where}: {what}" for what in wrong]


def _pids(collection: CollectionRun, victim: str) -> tuple[int, ...]:
    """Return the process ids of a victim.

    Raises:
        LookupError: It does not run.
    """
    processes, main = collection.processes(), collection.process.pid
    if victim == VICTIMS[0]:
        return (*(pid for pid in processes if pid != main), main)
    if victim == VICTIMS[1]:
        return (main,)
    name = victim.split()[1].removesuffix("'s")
    if victim.endswith("stream"):
        return (collection.stream(name),)
    if name in EMULATORS and victim.endswith("emulator"):
        return (collection.emulator(name),)
    streams = {collection.stream(stream) for stream in _STREAMS}
    spawned = {pid for pid, command in processes.items() if "multiprocessing.spawn" in command}
    return tuple(spawned - streams)


def _times(path: Path) -> dict[str, np.ndarray]:
    """Return t_ns of every readable row, by stream."""
    return {name: np.array(stream.t_ns) for name, stream in Session(path).streams.items()}


def _changed(before: dict[str, np.ndarray], path: Path) -> list[str]:
    """Return the streams in which rows that were readable before are gone or differ."""
    after = _times(path)
    return [
        name
        for name, times in before.items()
        if not np.array_equal(after[name][: len(times)], times)
    ]


def _complete(session: Path, bench: Path, done: Kills) -> None:
    """Resume a session until its plan is complete."""
    before = _times(session)
    with CollectionRun(session, "--bench", str(bench), "--resume", str(session)) as collection:
        code = collection.wait(_WHOLE)
        if code != 0:
            done.wrong.append(f"resume: exit {code}: {collection.last_line}")
    done.resumed += 1
    done.wrong += [
        f"resume: {name}: rows recorded before changed" for name in _changed(before, session)
    ]
