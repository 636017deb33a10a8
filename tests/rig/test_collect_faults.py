"""A device that fails during recording: clear message, correct exit code, data kept, arm stopped
or retracted."""

from __future__ import annotations

import json
import os
import signal
import socket
from pathlib import Path

import numpy as np
import pytest
from support.collecting import Collection, faults_of

from benchmarks.faults.collection_run import quick_bench
from recorder import OUTCOMES, Session
from rig.core.mock_names import PORTS

pytestmark = pytest.mark.serial

EMULATORS = ("arm", "camera", "force", "taxels", "world")


def pressing(folder: Path, sensor: str) -> Collection:
    """Start a collection and wait until it has recorded at least one phase."""
    bench = quick_bench(folder, sensor)
    run = Collection.start(folder / "s.zarr", "--targets", "4", "--bench", str(bench))
    run.until(run.recording)
    run.until(lambda: run.segments() > 0)
    return run


def stopped_in_order(run: Collection) -> Session:
    """Return the resulting session after checking that it is closed, complete and has a reason."""
    session = Session(run.session)
    assert session.status == "stopped"
    assert len(session.streams["force"]) > 500
    assert faults_of(run.session, stopped=True) == []
    assert run.lines[-1].startswith("stopped")
    assert str(run.session) in run.lines[-1]
    return session


@pytest.mark.parametrize(
    "device",
    # The other devices take the same path through the collector; `benchmarks faults` tests them.
    [
        pytest.param(device, marks=() if device == "force" else pytest.mark.slow)
        for device in EMULATORS
    ],
)
def test_a_killed_device_ends_the_session_with_everything_kept(device: str, tmp_path: Path) -> None:
    run = pressing(tmp_path, "uskin" if device == "taxels" else "tacpalm")
    os.kill(run.emulator(device), signal.SIGKILL)
    assert run.wait() == 3, run.text
    session = stopped_in_order(run)
    named = {"arm": "arm|pose|controller"}.get(device, device)
    assert any(word in session.attrs["reason"] for word in named.split("|")), run.text
    if device == "arm":
        assert "NOT RETRACTED" in session.attrs["reason"]
    else:
        height = session.streams["pose"].array("value")[-1][2] - session.attrs["contact_frame"][2]
        assert height > 0.015


@pytest.mark.slow
def test_a_killed_stream_process_ends_the_session_and_recover_mends_it(tmp_path: Path) -> None:
    from recorder import recover

    run = pressing(tmp_path, "tacpalm")
    os.kill(run.stream("camera"), signal.SIGKILL)
    assert run.wait() == 3, run.text
    assert "camera: its process ended" in run.text
    recover(run.session)
    session = Session(run.session)
    assert len(session.streams["camera"]) > 10
    assert faults_of(run.session, stopped=True) == []


@pytest.mark.slow
def test_a_protective_stop_ends_the_session_with_4_and_is_not_reset(tmp_path: Path) -> None:
    run = pressing(tmp_path, "tacpalm")
    with socket.create_connection((run.host(), PORTS["arm"]), 5.0) as port:
        port.sendall(json.dumps({"fault": "protective_stop"}).encode() + b"\n")
        assert b"protective" in port.recv(4096).lower()
    assert run.wait() == 4, run.text
    session = stopped_in_order(run)
    assert "protective" in session.attrs["reason"].lower()
    # Only a person may unlock it, so there is no retract either, and the reason states this.
    assert "NOT RETRACTED" in session.attrs["reason"]
    heights = np.asarray(session.streams["pose"].array("value"))[-20:, 2]
    assert np.ptp(heights) < 1e-6


@pytest.mark.slow
def test_the_hard_force_limit_stops_the_session_with_4(tmp_path: Path) -> None:
    # Both limits are equal, and with the shortest look-ahead the soft one seldom comes first.
    bench = limited_bench(tmp_path, hard=0.8, soft=0.8, rating=0.3, horizon_ms=0.5)
    run = Collection.start(tmp_path / "s.zarr", "--targets", "4", "--bench", str(bench))
    assert run.wait() == 4, run.text
    session = Session(run.session)
    assert session.status == "stopped"
    assert "Fz" in session.attrs["reason"]
    assert "NOT RETRACTED" not in session.attrs["reason"]
    *before, last = session.segments["outcome"]
    assert last == OUTCOMES.index("stopped")
    assert set(before) <= {OUTCOMES.index("force_limited")}
    force = np.asarray(session.streams["force"].array("value"))
    assert 0.2 < -force[:, 2].min() < 0.3


@pytest.mark.slow
def test_the_soft_force_limit_ends_the_target_and_goes_on(tmp_path: Path) -> None:
    bench = limited_bench(tmp_path, hard=5.0, soft=0.5, rating=0.4)
    run = Collection.start(tmp_path / "s.zarr", "--targets", "2", "--bench", str(bench))
    assert run.wait() == 0, run.text
    session = Session(run.session)
    limited = OUTCOMES.index("force_limited")
    assert list(session.segments["outcome"]) == [limited, limited]
    assert "Fz" in run.text


def limited_bench(
    folder: Path, *, hard: float, soft: float, rating: float, horizon_ms: float = 20.0
) -> Path:
    """Write the TacPalm's mock bench with different limits."""
    limits = {
        "force_rating_n": [12.0, 12.0, rating],
        "soft_fraction": soft,
        "hard_fraction": hard,
        "horizon_ms": horizon_ms,
        "stiffness_n_per_mm": 0.005,
    }
    return quick_bench(folder, "tacpalm", limits=json.dumps(limits))
