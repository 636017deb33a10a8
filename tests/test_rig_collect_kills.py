"""SIGKILL of every process at a random moment: nothing phantom, nothing half, nothing lost but what
was in flight, and the session goes on from there."""

from __future__ import annotations

import random
import re
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from collecting import Collection, faults_of, quick_bench

from recorder import Session
from recorder.recover import recover
from rig.camera.jpeg import frame_stamp
from rig.shared import LatestRecord
from rig.streams.kinds import KINDS

pytestmark = pytest.mark.timeout(300)


def run_folder(run: Collection) -> Path:
    """Where this collection's processes share their newest samples."""
    for command in run.processes().values():
        if found := re.search(r"--world (\S+)/world.state", command):
            return Path(found[1])
    raise LookupError("no emulator runs yet")


def latest_times(folder: Path) -> dict[str, int]:
    """t_ns of the newest sample each stream had shown, which it does only after storing it."""
    times = {}
    for path in folder.glob("*.latest"):
        record = LatestRecord.attach(path, KINDS[path.stem].latest)
        newest = record.read()
        times[path.stem] = int(newest["t_ns"]) if newest is not None else 0
        record.close()
    return times


def killed(folder: Path, rng: random.Random) -> tuple[Collection, dict[str, int]]:
    """A one-target collection, killed at a random moment of its recording."""
    bench = quick_bench(folder, "tacpalm")
    run = Collection.start(folder / "s.zarr", "--targets", "1", "--bench", str(bench))
    run.until(run.recording)
    shared = run_folder(run)
    time.sleep(rng.uniform(0.0, 3.5))
    run.kill_all()
    run.process.communicate()
    newest = latest_times(shared)
    shutil.rmtree(shared)
    return run, newest


def look_for_losses(path: Path, newest: dict[str, int]) -> None:
    """Whole rows only, consecutive, and every sample that was shown is there."""
    session = Session(path)
    assert session.status == "recovered"
    assert faults_of(path, stopped=True) == []
    for name, stream in session.streams.items():
        times = np.asarray(stream.t_ns)
        assert (np.diff(times) > 0).all()
        assert len(np.asarray(stream.column("device_t" if name != "force" else "seq"))) == len(
            times
        )
        if len(times):
            assert times[-1] >= newest[name], f"{name}: a stored sample is gone"
    seq = np.asarray(session.streams["force"].column("seq"))
    assert set(np.diff(seq)) <= {1}
    camera = session.streams["camera"]
    stamps = [frame_stamp(camera.jpeg(row) or b"") for row in range(len(camera))]
    assert None not in stamps
    assert camera.images(slice(0, len(camera))).shape == (len(camera), 480, 640, 3)


def resume(run: Collection) -> None:
    bench = quick_bench(run.session.parent, "tacpalm")
    again = Collection.start(run.session, "--resume", str(run.session), "--bench", str(bench))
    assert again.wait(100) == 0, again.text
    session = Session(run.session)
    assert session.status == "complete"
    assert len(session.runs) == 2
    # The killed run's streams may end before its last phase does.
    assert faults_of(run.session, stopped=True) == []


def test_a_killed_collection_loses_nothing_and_is_resumed(tmp_path: Path) -> None:
    run, newest = killed(tmp_path, random.Random(1))
    recover(run.session)
    look_for_losses(run.session, newest)
    before = {name: len(stream) for name, stream in Session(run.session).streams.items()}
    recover(run.session)
    assert before == {name: len(stream) for name, stream in Session(run.session).streams.items()}
    resume(run)


@pytest.mark.slow
@pytest.mark.parametrize("trial", range(20))
def test_twenty_kills_lose_nothing(tmp_path: Path, trial: int) -> None:
    run, newest = killed(tmp_path, random.Random(100 + trial))
    recover(run.session)
    look_for_losses(run.session, newest)
    if trial % 7 == 0:
        resume(run)
