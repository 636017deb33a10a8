"""Archives made on a Dask cluster: killed workers lose no results, and workers print nothing."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from support.simulated_archives import IMAGES, SKINS, UNITS, digests, make

from sim import SceneError
from sim.dataset import Stop, begin, fill, run
from sim.dataset.run import make_on_cluster
from tactile.__main__ import main

distributed = pytest.importorskip(
    "distributed", reason="dask.distributed is not installed: pip install 'tactile-rig[cluster]'"
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    # Dask leaves sockets to the garbage collector when its workers are killed.
    pytest.mark.filterwarnings("ignore"),
]


@pytest.fixture(autouse=True)
def nothing_left_behind() -> None:
    """Override the general check: Dask keeps its own threads, and ends its processes."""


@pytest.fixture
def local() -> Iterator[Any]:
    """Two single-threaded worker processes, each with a nanny that restarts it."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as made:
        yield made


def test_a_cluster_gives_the_bytes_of_one_process_though_a_worker_is_killed(
    tmp_path: Path, local: Any
) -> None:
    make(tmp_path / "alone.markers.zarr", SKINS)
    begun, stop = begin(tmp_path / "a.markers.zarr", SKINS), Stop()
    killed: list[int] = []

    def making(units: Any, inside: Any) -> Any:
        address = local.scheduler_address
        for made in make_on_cluster(begun, units, address=address, device="cpu", stop=stop):
            if not killed:
                worker = next(iter(local.workers.values()))
                killed.append(worker.process.pid)
                os.kill(killed[0], signal.SIGKILL)
            yield made

    filled = fill(begun, making, stop, lambda fraction: None)
    assert killed
    assert filled.complete
    assert filled.images == IMAGES
    assert digests(begun.path) == digests(tmp_path / "alone.markers.zarr")


def test_a_stop_leaves_what_no_worker_has(tmp_path: Path, local: Any) -> None:
    begun, stop = begin(tmp_path / "a.markers.zarr", SKINS), Stop()
    stop.asked = True
    filled = fill(
        begun,
        lambda units, inside: make_on_cluster(
            begun, units, inside, address=local.scheduler_address, device="cpu", stop=stop
        ),
        stop,
        lambda fraction: None,
    )
    assert not filled.complete
    assert filled.left == UNITS


def test_nobody_at_the_address_is_wrong_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "WORKERS_WITHIN", 2.0)
    begun = begin(tmp_path / "a.markers.zarr", SKINS)
    missing, rest = begun.missing(), {"device": "cpu", "stop": Stop()}
    with pytest.raises(SceneError, match=r"--scheduler: 'tcp://127.0.0.1:9'.*allowed: one that"):
        list(make_on_cluster(begun, missing, address="tcp://127.0.0.1:9", **rest))
    with pytest.raises(SceneError, match=r"--scheduler: 'nonsense://x'"):
        list(make_on_cluster(begun, missing, address="nonsense://x", **rest))


def test_processes_and_a_scheduler_exclude_each_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    begin(tmp_path / "a.markers.zarr", SKINS)
    options = ("--scheduler", "tcp://127.0.0.1:9", "--processes", "2")
    assert main(["sim", "archive", "resume", str(tmp_path / "a.markers.zarr"), *options]) == 2
    assert "--processes: 2 with --scheduler; allowed: either" in capsys.readouterr().err
