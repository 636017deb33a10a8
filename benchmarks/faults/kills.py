"""Kill random processes at random times, recover after each kill, and complete the session.

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

from benchmarks.faults.collection_run import EMULATORS, CollectionRun, Hangs
from benchmarks.faults.judge import arm_in_words, complaints, left_in, losses
from benchmarks.faults.processes import kill, wait_gone
from benchmarks.faults.quick import quick_bench
from recorder import Session, SessionError, recover
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
_BENCH_GOES_TOO = VICTIMS[:2]
_TARGETS = 6
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


Report = Callable[[str], None]


def kill_often(
    folder: Path,
    benches: Path,
    *,
    kills: int,
    sessions: int,
    seed: int,
    report: Report,
    targets: int = _TARGETS,
) -> Kills:
    """Kill `kills` times, over `sessions` sessions, and complete each session.

    Args:
        folder: Empty folder for the sessions.
        benches: Folder of the bench files.
        kills: Number of kills.
        sessions: Number of sessions.
        seed: Random seed of victims and times.
        report: Called with a line after each kill and each session.
        targets: Number of targets of each session.
    """
    rng = random.Random(seed)
    found = Kills()
    for number in range(sessions):
        fraction = (kills - found.victims.total()) // (sessions - number)
        place = folder / f"chain-{number}"
        place.mkdir()
        _chain(_Place(place, benches, targets), fraction, rng, found, report)
        if not found.wrong:
            shutil.rmtree(place)
    return found


@dataclass(frozen=True, slots=True)
class _Place:
    """Folder, benches and number of targets of one session."""

    folder: Path
    benches: Path
    targets: int


def _chain(place: _Place, kills: int, rng: random.Random, found: Kills, report: Report) -> None:
    bench = quick_bench(place.folder, _SENSOR, place.benches)
    session = place.folder / "s.zarr"
    for _ in range(kills):
        if session.exists() and Session(session).status == "complete":
            # It completed between two kills, so the remaining kills go to another session.
            session.rename(place.folder / f"done-{found.completed}.zarr")
            found.completed += 1
        begun = session.exists()
        arguments = ("--resume", str(session)) if begun else ("--targets", str(place.targets))
        try:
            with CollectionRun(session, "--bench", str(bench), *arguments) as collection:
                report(_killed(collection, rng, found))
                found.resumed += begun
        except (Hangs, LookupError, SessionError, OSError) as error:
            found.wrong.append(f"kill {found.victims.total()}: {error}")
            report(found.wrong[-1])
            return
    report(_brought_to_its_end(session, bench, found))


def _killed(collection: CollectionRun, rng: random.Random, found: Kills) -> str:
    """Kill one victim, check the session and recover it."""
    collection.until_recording()
    # Damage by later runs can be detected in sealed rows only.
    before = _times(collection.session)
    clock = SystemClock()
    wait = rng.uniform(0.0, _LONGEST)
    clock.sleep_until(clock.now_ns() + round(wait * SECOND_NS))
    victim = rng.choice(VICTIMS)
    everybody = collection.processes()
    collection.kill(*_pids(collection, victim))
    code = collection.wait(_ENDING)
    left = wait_gone(everybody, _ENDING)
    kill(left)
    found.victims[victim] += 1
    where = f"kill {found.victims.total()}, {victim}, {wait:.1f} s into recording"
    if left:
        commands = "; ".join(everybody[pid].strip()[-60:] for pid in left)
        found.wrong.append(f"{where}: did not end within {_ENDING:g} s: {commands}")
    if victim not in _BENCH_GOES_TOO:
        gone = victim == "the arm emulator"
        arm, standing = arm_in_words(collection.seen(), collection.ended_ns, gone)
        if not standing:
            found.wrong.append(f"{where}: the arm: {arm}")
    if collection.folder is not None:
        shutil.rmtree(collection.folder, ignore_errors=True)
    recover(collection.session)
    compared, lost = losses(collection.session, collection.seen())
    after = _times(collection.session)
    lost += sum(
        int(not np.array_equal(after[name][: len(times)], times)) for name, times in before.items()
    )
    found.compared += compared
    found.lost += lost
    if lost:
        found.wrong.append(f"{where}: {lost} accepted samples are missing")
    found.wrong += [
        f"{where}: {what}" for what in complaints(collection.session, left_in(collection.session))
    ]
    return f"{where}: exit {code}, {compared} samples looked for, {lost} lost"


def _pids(collection: CollectionRun, victim: str) -> tuple[int, ...]:
    """Return the process ids of a victim.

    Raises:
        LookupError: It does not run.
    """
    processes = collection.processes()
    main = collection.process.pid
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


def _brought_to_its_end(session: Path, bench: Path, found: Kills) -> str:
    """Resume a session until its plan is complete."""
    if Session(session).status != "complete":
        before = _times(session)
        with CollectionRun(session, "--bench", str(bench), "--resume", str(session)) as collection:
            try:
                code = collection.wait(_WHOLE)
            except Hangs as error:
                found.wrong.append(str(error))
                return found.wrong[-1]
            if code != 0:
                found.wrong.append(f"resume: exit {code}: {collection.last_line}")
        found.resumed += 1
        after = _times(session)
        for name, times in before.items():
            if not np.array_equal(after[name][: len(times)], times):
                found.wrong.append(f"resume: {name}: rows recorded before changed")
    left = left_in(session)
    found.wrong += [f"resumed session: {what}" for what in complaints(session, left)]
    if left.status == "complete":
        found.completed += 1
    else:
        found.wrong.append(f"resumed session: status {left.status}; right: complete")
    rows = ", ".join(f"{count} {name}" for name, count in left.rows.items())
    return (
        f"session {found.completed}: {left.status} after {len(Session(session).runs)} runs, {rows}"
    )
