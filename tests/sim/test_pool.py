"""Scenes distributed over processes: equal results, and no process survives an error."""

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from recorder.processes import WorkerLost, Workers
from sim import Body, Result, Scene, SceneError, SimulationDiverged, press, simulate_many
from sim.fem import Fem
from sim.indenters import sphere
from sim.tiers import gathered, submitted

BODY = Body(size_x=8e-3, size_y=8e-3, thickness=4e-3)
NUMERICS = Fem(spacing=4e-3 / 3, precision="float64", newton_max=8, halvings=0)
SCENES = [
    Scene(sphere(3e-3), press([depth], at=at), BODY)
    for depth, at in ((0.1e-3, (0, 0)), (0.2e-3, (1e-3, 0)), (0.1e-3, (0, 1e-3)))
]
# Many minutes, so that a stopped process has not finished by itself.
HEAVY = Scene(sphere(4e-3), press([0.01e-3 * step for step in range(1, 101)]))
HEAVY_NUMERICS = Fem(spacing=0.3e-3)


@pytest.fixture(autouse=True)
def _dumps_in_a_folder_of_the_test(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))


def workers() -> list[int]:
    """Return our processes started by `multiprocessing`, without its resource tracker."""
    listed = Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split()
    return [pid for pid in map(int, listed) if b"spawn_main" in command(pid)]


def command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return b""


@pytest.mark.slow
def test_two_processes_give_the_same_bits_in_the_same_order_and_print_nothing(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """And refuse a scene that means nothing as itself; the same two solve several calls."""
    told: list[float] = []
    alone, nothing = simulate_many(SCENES, NUMERICS), replace(NUMERICS, spacing=0.3e-6)
    with pytest.raises(SceneError) as here:
        simulate_many(SCENES, nothing)
    capfd.readouterr()
    with Workers(2) as solvers:
        shared = simulate_many(SCENES, NUMERICS, processes=solvers, progress=told.append)
        assert capfd.readouterr() == ("", "")
        pids = workers()
        assert simulate_many([], NUMERICS, processes=solvers) == []
        (more,) = simulate_many(SCENES[:1], replace(NUMERICS, tolerance=1e-3), processes=solvers)
        assert isinstance(more, Result)
        assert workers() == pids != []
        with pytest.raises(SceneError) as there:
            simulate_many(SCENES, nothing, processes=solvers)
    assert str(there.value) == str(here.value)
    assert not workers()
    for one, other, scene in zip(alone, shared, SCENES, strict=True):
        assert isinstance(one, Result)
        assert isinstance(other, Result)
        assert one.scene == other.scene == scene
        for name in ("wrench", "surface_x", "surface_y", "surface", "traction"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
        for name in one.quality.__slots__:
            values = getattr(one.quality, name), getattr(other.quality, name)
            assert np.array_equal(*values, equal_nan=True), name
        assert one.record["mesh"] == other.record["mesh"]
    assert told == [1 / 3, 2 / 3, 1]


@pytest.mark.slow
def test_a_press_without_a_solution_comes_back_whole_beside_those_that_have_one() -> None:
    numerics = replace(NUMERICS, newton_max=3)
    scenes = [Scene(sphere(3e-3), press([2e-6]), BODY), Scene(sphere(3e-3), press([1e-3]), BODY)]
    fine, diverged = simulate_many(scenes, numerics, processes=2)
    _, here = simulate_many(scenes, numerics)
    assert isinstance(fine, Result)
    assert isinstance(diverged, SimulationDiverged)
    assert isinstance(here, SimulationDiverged)
    assert diverged.tried == here.tried != ()
    assert str(diverged).split("state:")[0] == str(here).split("state:")[0]
    assert diverged.dump is not None
    assert diverged.dump.exists()
    again = pickle.loads(pickle.dumps(diverged))
    assert (str(again), again.tried, again.dump) == (str(diverged), diverged.tried, diverged.dump)


def test_beside_a_gpu_each_process_solves_its_part_as_one_batch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[tuple[list[float], Fem, str]] = []

    def submit(_call: object, scenes: list[Scene], tier: Fem, device: str) -> Future[list[str]]:
        depths = [scene.motion.depth_max for scene in scenes]
        given.append((depths, tier, device))
        done: Future[list[str]] = Future()
        done.set_result([f"{depth:g} {tier.spacing}" for depth in depths])
        return done

    told: list[float] = []
    scenes = [Scene(sphere(3e-3), press([depth * 1e-4]), BODY) for depth in (1, 2, 3, 4, 5)]
    fine, coarse = (Fem(spacing=height, one_topology=True) for height in (8e-4, 1e-3))
    with Workers(2) as solvers:
        monkeypatch.setattr(solvers, "submit", submit)
        found: list[Any] = [
            gathered(solvers, submitted(solvers, scenes, tier, "cuda:0"), told.append)
            for tier in (fine, coarse)
        ]
        # Meshes of their own: neighbours stay with each other.
        submitted(solvers, scenes, Fem(), "cuda:0")
    assert found == [[f"0.000{d} {h}" for d in (1, 2, 3, 4, 5)] for h in ("0.0008", "0.001")]
    assert told[-1] == 1.0
    rounded = [[round(depth * 1e4) for depth in depths] for depths, *_ in given]
    assert rounded == [[1, 3, 5], [2, 4], [1, 3, 5], [2, 4], [1, 2], [3, 4, 5]]
    assert [tier.spacing for _, tier, _ in given] == [8e-4, 8e-4, 1e-3, 1e-3, None, None]
    assert {device for *_, device in given} == {"cuda:0"}


def test_processes_on_a_cpu_make_no_meshes_agree() -> None:
    with pytest.raises(SceneError, match=r"fem.one_topology: True with 2 processes"):
        simulate_many(SCENES, Fem(one_topology=True), processes=2)


def once_two_work(act: Callable[[list[int]], None]) -> threading.Thread:
    """Call `act` with the worker processes once two exist and have had time to begin."""

    def wait() -> None:
        parent = f"/proc/{os.getpid()}/task"
        found: list[int] = []
        while len(found) < 2:
            time.sleep(0.05)
            listed = [
                int(pid)
                for thread in os.listdir(parent)
                for pid in Path(f"{parent}/{thread}/children").read_text().split()
            ]
            found = [pid for pid in listed if b"spawn_main" in command(pid)]
        time.sleep(0.3)
        act(found)

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    return thread


def test_a_worker_that_is_killed_is_told_of_and_takes_the_others_with_it() -> None:
    thread = once_two_work(lambda found: os.kill(found[0], signal.SIGKILL))
    with pytest.raises(
        WorkerLost, match=r"killed by SIGKILL, most likely for lack of memory, 0 of"
    ):
        simulate_many([HEAVY] * 3, HEAVY_NUMERICS, processes=2)
    thread.join()
    assert not workers()


def test_ctrl_c_stops_the_workers_at_once() -> None:
    """Their calls take minutes: waited for, they would outlast the time of a test."""
    thread = once_two_work(lambda _pids: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        simulate_many([HEAVY] * 3, HEAVY_NUMERICS, processes=2)
    thread.join()
    assert not workers()


SCRIPT = """
import sys
from sim import Scene, press, simulate_many
from sim.fem import Fem
from sim.indenters import sphere
{guard}
    print("begun", flush=True)
    simulate_many([Scene(sphere(4e-3), press([1e-3]))] * 3, Fem(spacing=0.3e-3),
                  processes=2)
"""


def script(tmp_path: Path, guard: str) -> subprocess.Popen[str]:
    path = tmp_path / "script.py"
    path.write_text(SCRIPT.format(guard=guard))
    return subprocess.Popen(
        [sys.executable, str(path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
        start_new_session=True,
    )


def group(leader: int) -> list[int]:
    """Return the processes of the session that `leader` started."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and b"spawn_main" in command(int(folder.name)):
            try:
                if os.getsid(int(folder.name)) == leader:
                    found.append(int(folder.name))
            except ProcessLookupError:
                continue
    return found


@pytest.mark.slow
@pytest.mark.parametrize("with_signal", [signal.SIGINT, signal.SIGKILL])
def test_workers_do_not_outlive_their_parent(tmp_path: Path, with_signal: signal.Signals) -> None:
    parent = script(tmp_path, 'if __name__ == "__main__":')
    while len(group(parent.pid)) < 2:
        time.sleep(0.05)
    time.sleep(0.3)
    # Like a terminal: to every process of the group.
    if with_signal == signal.SIGINT:
        os.killpg(parent.pid, with_signal)
    else:
        parent.kill()
    message = parent.communicate()[1]
    while group(parent.pid):
        time.sleep(0.05)
    if with_signal == signal.SIGINT:
        assert message.count("Traceback") == 1, message
        assert message.rstrip().endswith("KeyboardInterrupt")


@pytest.mark.slow
def test_a_script_without_its_guard_is_told_so(tmp_path: Path) -> None:
    parent = script(tmp_path, "if True:")
    message = parent.communicate()[1]
    assert parent.returncode == 1
    assert "ended with exit code 1, 0 of 3 scenes done; a script that starts processes" in message
