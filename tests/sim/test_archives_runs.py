"""Archives that are stopped, killed, resumed, or made in parallel and out of order are equal."""

import errno
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.commands import python
from support.copies import digests
from support.simulated_archives import SKINS, UNITS, make, own_grid, solved_once

from recorder import MarkerArchive, check
from recorder.processes import WorkerLost
from sim.dataset import DatasetPlan, OpenArchive, Unit, begin, fill, reopened
from sim.dataset.plan import UNIT_PRESSES, units
from sim.dataset.run import make_here, make_in_processes
from sim.layer.batch import simulate_layers
from tactile.__main__ import main

pytestmark = pytest.mark.slow

__all__ = ["own_grid", "solved_once"]

ROOT = Path(__file__).parents[2]
OPTIONS = ("r6,r18,uskin", "--indenters", "sphere,cone", "--scale", "0.01", "--steps",
           "1", "--tier", "layer")  # fmt: skip
SKINS_OF_THE_COMMAND: DatasetPlan = replace(
    SKINS, unit_presses=UNIT_PRESSES, batch_size=UNIT_PRESSES
)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    path = tmp_path_factory.mktemp("undisturbed") / "a.markers.zarr"
    make(path, SKINS)
    return digests(path)


def backwards(missing: Sequence[Unit]) -> list[Unit]:
    return list(reversed(missing))


def test_stopped_again_and_again_and_made_in_another_order_it_is_the_same(
    tmp_path: Path, undisturbed: dict[str, str]
) -> None:
    path = tmp_path / "a.markers.zarr"
    for left in range(UNITS - 1, -1, -1):
        begun = begin(path, SKINS)
        fractions: list[float] = []

        def one_and_stop(
            missing: Sequence[Unit], inside: object, begun: OpenArchive = begun
        ) -> Any:
            yield from make_here(begun, backwards(missing)[:1], device="cpu")
            if len(missing) > 1:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt) if left else nullcontext():
            fill(begun, one_and_stop, fractions.append)
        assert fractions == sorted(fractions)
        assert len(begun.missing()) == left
    assert digests(path) == undisturbed
    assert make(path, SKINS) == 0


def test_a_full_disk_is_told_with_how_to_go_on_and_going_on_gives_the_same(
    tmp_path: Path,
    undisturbed: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "a.markers.zarr"
    begin(path, SKINS)
    monkeypatch.setattr("sim.dataset.run.make_in_processes", _here)
    real, room = os.write, [60_000]

    def write(fd: int, data: Any) -> int:
        if fd > 2:
            room[0] -= len(data)
            if room[0] < 0:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(fd, data)

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", write)
        assert main(["sim", "archive", str(path)]) == 2
    reported = capsys.readouterr().err
    assert "No space left on device" in reported
    assert f"to continue: tactile sim archive {path}" in reported
    assert MarkerArchive(path).status == "writing"
    make(path, SKINS)
    assert digests(path) == undisturbed


def test_ctrl_c_keeps_what_is_written_and_exits_with_130(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(begun: Any, missing: Any, inside: Any, **how: Any) -> Any:
        yield from make_here(begun, missing[:1], device="cpu")
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("sim.dataset.run.make_in_processes", stopped)
    path = tmp_path / "a.markers.zarr"
    assert main(["sim", "archive", *OPTIONS, "--out", str(path)]) == 130
    reported = capsys.readouterr()
    assert "images in" not in reported.out
    assert "interrupted; written files are kept; to continue: tactile sim archive" in reported.err
    assert len(reopened(path).missing()) < len(units(SKINS_OF_THE_COMMAND))


def test_the_command_tells_the_contents_before_and_the_sum_after_and_a_sheet_is_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sim.dataset.run.make_in_processes", _here)
    path = tmp_path / "a.markers.zarr"
    begun = ("archive", "states:Array3", "--indenters", "sphere", "--tier", "layer")
    assert main(["sim", *begun, "--out", str(path)]) == 0
    reported = capsys.readouterr().out
    assert "9 presses (layer (small strain)), 45 frames, 45 images, about" in reported
    assert "1 sensors, 45 images" in reported
    assert list(MarkerArchive(path)) == ["Array3"]
    assert "marker count: 0 of 45 images flagged" in reported
    assert list(check(path)) == []
    assert main(["sim", *begun, "--out", str(path)]) == 0
    assert "nothing is missing" in capsys.readouterr().out
    assert main(["sim", *begun, "--seed", "3", "--out", str(path)]) == 2
    assert "another plan, which differs in seed; allowed" in capsys.readouterr().err


# ------------------------------------------------------------------------------- slow: processes


@pytest.fixture
def in_one_process(own_grid: None, tmp_path: Path) -> dict[str, str]:
    make(tmp_path / "one.markers.zarr", SKINS)
    return digests(tmp_path / "one.markers.zarr")


@pytest.mark.parametrize(
    ("maker", "processes"), [(make_in_processes, 1), (make_in_processes, 2), (make_here, 2)]
)
def test_processes_give_the_bytes_of_one(
    tmp_path: Path, in_one_process: dict[str, str], maker: Any, processes: int
) -> None:
    begun = begin(tmp_path / "a.markers.zarr", SKINS)
    fill(
        begun,
        lambda units, inside: maker(begun, units, inside, processes=processes, device="cpu"),
        lambda fraction: None,
    )
    assert MarkerArchive(begun.path).status == "complete"
    assert digests(begun.path) == in_one_process


def test_a_process_that_is_killed_is_told_of_and_loses_its_unit_alone(
    tmp_path: Path, in_one_process: dict[str, str]
) -> None:
    begun = begin(tmp_path / "a.markers.zarr", SKINS)
    making = make_in_processes(begun, begun.missing(), processes=1)
    next(making)
    listed = Path(f"/proc/self/task/{threading.get_native_id()}/children").read_text().split()
    for pid in map(int, listed):
        if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
            os.kill(pid, signal.SIGKILL)
    with pytest.raises(WorkerLost, match=r"killed by SIGKILL.*1 of 5 units done"):
        list(making)
    assert len(begun.missing()) == UNITS - 1
    make(begun.path, SKINS)
    assert digests(begun.path) == in_one_process


def _verb(path: Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "tactile", "sim", "archive", *OPTIONS, "--out", str(path)],
        cwd=ROOT,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.mark.timeout(600)
def test_killed_at_random_moments_and_started_again_it_is_the_same(tmp_path: Path) -> None:
    whole, torn = tmp_path / "whole.markers.zarr", tmp_path / "torn.markers.zarr"
    alone = _verb(whole)
    began = time.monotonic()
    alone.communicate(timeout=240)
    assert alone.returncode == 0
    lasts = time.monotonic() - began
    chance = random.Random(6)
    kills = 0
    while kills < 6:
        process = _verb(torn)
        time.sleep(chance.uniform(0.2, 1.0) * lasts)
        ended = process.poll() is not None
        if not ended:
            os.killpg(process.pid, signal.SIGKILL)
            kills += 1
        process.communicate(timeout=240)
        if ended:
            shutil.rmtree(torn)
    last = _verb(torn)
    last.communicate(timeout=240)
    assert last.returncode == 0
    assert digests(torn) == digests(whole)


def test_ctrl_c_between_processes_ends_with_130(tmp_path: Path) -> None:
    path = tmp_path / "a.markers.zarr"
    process = _verb(path)
    entries = lambda: list(path.glob("*/markers/ledger/*.npz"))  # noqa: E731
    while not entries():
        time.sleep(0.02)
        assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)
    reported = process.communicate(timeout=240)
    assert process.returncode == 130, reported
    assert "Traceback" not in reported[1]
    assert "to continue: tactile sim archive" in reported[1]
    assert reopened(path).plan == SKINS_OF_THE_COMMAND
    python("-m", "tactile", "sim", "archive", path)
    assert list(check(path)) == []


def test_presses_of_layer_are_solved_on_the_gpu_in_large_units(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, str]] = []
    solved: list[int] = []

    def here(begun: Any, missing: Any, inside: Any, **how: Any) -> Any:
        asked.append((begun.plan.batch_size, how["device"]))
        return make_here(begun, missing, inside, device="cuda:0")

    def solved_there(scenes: Any, layer: Any, *, device: str, progress: Any) -> Any:
        assert device == "cuda:0"
        solved.append(len(scenes))
        return simulate_layers(scenes, layer, device="cpu", progress=progress)

    monkeypatch.setattr("sim.dataset.run.make_here", here)
    monkeypatch.setattr("sim.device.ready_device", lambda name: None)
    monkeypatch.setattr("sim.layer.batch.simulate_layers", solved_there)
    path = tmp_path / "a.markers.zarr"
    small = ("--indenters", "sphere,torus", "--scale", "0.002", "--steps", "1", "--no-check")
    where = ("--device", "cuda:0", "--out", str(path), "--tier", "layer")
    code = main(["sim", "archive", "uskin", *small, *where])
    assert (code, asked) == (0, [(162, "cuda:0")])
    assert solved


def _here(begun: Any, missing: Any, inside: Any, *, processes: int, device: str) -> Any:
    """Make units in this process instead of worker processes."""
    return make_here(begun, missing, inside, device="cpu")
