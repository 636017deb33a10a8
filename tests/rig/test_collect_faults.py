"""A force that is lost or too large during recording; `benchmarks faults` has all other faults."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from support.collecting import Collection, faults_of

from benchmarks.faults.collection_run import quick_bench
from recorder import OUTCOMES, Session

pytestmark = pytest.mark.serial


def test_a_killed_device_ends_the_session_with_everything_kept(tmp_path: Path) -> None:
    bench = quick_bench(tmp_path, "tacpalm")
    run = Collection.start(tmp_path / "s.zarr", "--targets", "4", "--bench", str(bench))
    run.until(run.recording)
    run.until(lambda: run.segments() > 0)
    os.kill(run.emulator("force"), signal.SIGKILL)
    assert run.wait() == 3, run.text
    session = Session(run.session)
    assert session.status == "stopped"
    assert len(session.streams["force"]) > 500
    assert faults_of(run.session, stopped=True) == []
    assert run.lines[-1].startswith("stopped")
    assert str(run.session) in run.lines[-1]
    assert "force" in session.attrs["reason"]
    height = session.streams["pose"].array("value")[-1][2] - session.attrs["contact_frame"][2]
    assert height > 0.015


@pytest.mark.slow
def test_the_soft_force_limit_ends_the_target_and_goes_on(tmp_path: Path) -> None:
    limits = {"force_rating_n": [12.0, 12.0, 0.4], "soft_fraction": 0.5, "hard_fraction": 5.0}
    limits |= {"horizon_ms": 20.0, "stiffness_n_per_mm": 0.005}
    bench = quick_bench(tmp_path, "tacpalm", limits=json.dumps(limits))
    run = Collection.start(tmp_path / "s.zarr", "--targets", "2", "--bench", str(bench))
    assert run.wait() == 0, run.text
    limited = OUTCOMES.index("force_limited")
    assert list(Session(run.session).segments["outcome"]) == [limited, limited]
    assert "Fz" in run.text
