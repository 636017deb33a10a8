"""Units made by the workers of a Dask cluster, which write them to a file system that all share.

A worker that is killed loses nothing: its unit runs again elsewhere, and a unit that two of them
write is the same twice.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

from sim.archives.beginning import Begun
from sim.archives.families import Unit
from sim.archives.making import Made, make_unit
from sim.archives.plan import Plan
from sim.archives.stopping import Stop
from sim.errors import SceneError
from sim.pool import WorkerLost
from sim.verbs.device import ready_device

WORKERS_WITHIN = 30.0
"""How long the first worker is waited for [s]."""
_ONE_AT_A_TIME = threading.Lock()
"""A worker with several threads makes one unit at a time all the same."""


def make_on_cluster(
    begun: Begun,
    units: Sequence[Unit],
    inside: object = None,
    *,
    address: str,
    device: str,
    stop: Stop,
) -> Iterator[Made]:
    """Make units, in the order in which they are done.

    Args:
        begun: The archive; its path is the same for every worker.
        units: What is missing of it.
        inside: Not called: several units are in hand.
        address: Of the scheduler, such as `tcp://host:8786`.
        device: Where each worker makes its units.
        stop: Once asked, units that no worker has are left.

    Raises:
        SceneError: Dask is not installed, or nobody answers; and as `make_unit`.
        OSError: As `make_unit`.
        WorkerLost: A unit took several workers with it, so that Dask gave up.
    """
    distributed = _distributed()
    try:
        client = distributed.Client(address, timeout=WORKERS_WITHIN, set_as_default=False)
    except (OSError, ValueError) as error:
        raise SceneError(f"--scheduler: {address!r}: {error}; allowed: one that runs") from error
    path, run = begun.path.resolve(), uuid4().hex
    rest = iter(units)
    with client:
        try:
            client.wait_for_workers(1, timeout=WORKERS_WITHIN)
        except TimeoutError as error:
            raise SceneError(
                f"--scheduler: {address!r} has no workers; allowed: one that has"
            ) from error
        done = distributed.as_completed(loop=client.loop)
        flying: dict[str, Any] = {}
        try:
            while True:
                # Twice as many as there are threads, so that nobody waits for us.
                room = 2 * max(1, sum(client.nthreads().values()))
                while len(flying) < room and not stop.asked:
                    unit = next(rest, None)
                    if unit is None:
                        break
                    future = client.submit(
                        make_there,
                        path,
                        begun.plan,
                        unit,
                        device,
                        key=f"unit-{run}-{unit.number}",
                        pure=False,
                    )
                    flying[future.key] = future
                    done.add(future)
                if not flying:
                    return
                future = next(done)
                del flying[future.key]
                yield _result(distributed, future)
        finally:
            client.cancel(list(flying.values()), force=True)


def make_there(path: Path, plan: Plan, unit: Unit, device: str) -> Made:
    """Make a unit in a worker of the cluster."""
    with _ONE_AT_A_TIME:
        ready_device(device)
        return make_unit(path, plan, unit, device)


def _result(distributed: Any, future: Any) -> Made:
    try:
        made: Made = future.result()
    except distributed.KilledWorker as error:
        raise WorkerLost(
            f"{future.key}: every worker that took it was killed, most likely for lack of memory; "
            "allowed: more memory each, or fewer presses together"
        ) from error
    return made


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise SceneError(
            "--scheduler: dask.distributed is not installed; allowed: "
            "pip install 'tactile-rig[cluster]'"
        ) from error
    return distributed
