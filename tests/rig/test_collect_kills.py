"""SIGKILL of every process at a random moment: no invented or partial rows, no loss except data in
flight, and the session can be resumed."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.faults.collection_kills import VICTIMS, Kills, kill_often

pytestmark = pytest.mark.serial


# The first draw of this seed kills all processes.
SEED_OF_ALL = 25


def killed(folder: Path, kills: int, sessions: int, *, seed: int, targets: int) -> Kills:
    found = kill_often(folder, kills=kills, sessions=sessions, seed=seed, targets=targets)
    assert found.wrong == []
    assert found.lost == 0
    assert found.victims.total() == kills
    assert found.completed >= sessions
    return found


@pytest.mark.slow
def test_a_killed_collection_loses_nothing_and_is_resumed(tmp_path: Path) -> None:
    found = killed(tmp_path, 1, 1, seed=SEED_OF_ALL, targets=2)
    assert found.victims == {VICTIMS[0]: 1}
    assert found.resumed == 1
    assert found.compared > 0


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_twenty_kills_lose_nothing(tmp_path: Path) -> None:
    found = killed(tmp_path, 20, 2, seed=1, targets=6)
    assert found.resumed >= 18
    assert found.compared > 1000
