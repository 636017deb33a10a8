"""Whole collections on the mock bench, as a technician runs them."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support.collecting import faults_of, patient_bench
from support.mock_errors import within_stated

from benchmarks.faults.collection_run import CollectionRun
from benchmarks.faults.judge import stored_in
from benchmarks.faults.kills import kill_often
from learning.markers.recording import read_recording
from recorder import OUTCOMES, Session
from rig.devices.camera.jpeg import frame_stamp
from rig.mock.world.truth import Truth
from tactile.__main__ import main

pytestmark = pytest.mark.serial
Collected = tuple[Session, CollectionRun, Path]


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Collected:
    """Two targets of the TacPalm, with ground truth."""
    folder = tmp_path_factory.mktemp("collected")
    truth = folder / "truth"
    bench = patient_bench(folder, "tacpalm")
    run = CollectionRun.collect(
        *(folder / "s.zarr", "--targets", "2", "--truth", str(truth), "--bench", str(bench))
    )
    assert run.wait(240) == 0, run.text
    return Session(run.session), run, truth


def test_it_is_complete_clean_and_says_mock(collected: Collected) -> None:
    session, run, _ = collected
    assert run.lines[0].startswith("MOCK BENCH")
    assert session.attrs["mock"] is True
    assert session.status == "complete"
    assert faults_of(run.session) == []
    assert run.lines[-1].startswith("complete: 2 of 2 targets")
    for word in ("force", "pose", "camera", "longest gap", "lost", "worst skew", "paper: 20 to"):
        assert word in run.text
    assert run.session.with_suffix(".png").exists()


def test_every_phase_and_reference_of_every_target_is_there(collected: Collected) -> None:
    session = collected[0]
    segments, reference = session.segments, session.reference
    assert list(segments["target"]) == [0, 0, 0, 0, 1, 1, 1, 1]
    assert list(segments["phase"]) == [0, 1, 2, 3] * 2
    assert set(segments["outcome"]) == {OUTCOMES.index("complete")}
    assert (np.asarray(segments["end_ns"]) > np.asarray(segments["start_ns"])).all()
    assert list(reference["point"]) == [1]
    assert np.abs(np.asarray(reference["wrench"])[0, :3]).max() < 0.05
    assert int(reference["image"][0]) >= 0


def test_the_tip_was_where_the_plan_wants_it_and_the_frames_know(collected: Collected) -> None:
    frames = collected[0].frames
    # Nearly all are valid; a shared machine may stop for a second.
    assert np.asarray(frames["valid"]).mean() > 0.7
    assert np.nanmax(frames["depth"]) == pytest.approx(1.125e-3, abs=5e-5)
    pressed = np.asarray(frames["wrench"])[np.asarray(frames["depth"]) > 1.0e-3]
    assert (pressed[:, 2] < -0.1).all()


def test_what_was_recorded_is_what_the_world_felt(collected: Collected) -> None:
    session, _, path = collected
    truth, force, pose = Truth(path), session.streams["force"], session.streams["pose"]
    inside = force.t_ns < truth.records["t_ns"][-1]
    raw = np.asarray(force.array("value"))[inside] + np.asarray(force.attrs["bias"])
    error = raw - truth.wrench(force.t_ns[inside])
    # 0.01 N of noise, and a few milliseconds at a few N/s; robust to a stalled machine.
    assert np.median(np.abs(error[:, :3])) < 0.02
    inside = pose.t_ns < truth.records["t_ns"][-1]
    place = np.asarray(pose.array("value"))[inside][:, :3]
    distance = np.linalg.norm(place - truth.position(pose.t_ns[inside]), axis=1)
    assert np.median(distance) < 1e-4


def test_poses_and_forces_came_with_none_skipped_and_images_in_order(collected: Collected) -> None:
    session, run, _ = collected
    stored = stored_in(run.session)
    assert stored.missing | {"camera": 0} == dict.fromkeys(stored.missing, 0)
    assert set(stored.disorder.values()) == {0}
    assert session.attrs["summary"]["force"]["dropped"] == 0
    camera = session.streams["camera"]
    assert None not in [frame_stamp(camera.jpeg(row) or b"") for row in range(len(camera))]


@pytest.mark.slow
def test_ctrl_c_finishes_the_row_retracts_and_a_resume_completes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = patient_bench(tmp_path, "tacpalm")
    run = CollectionRun.collect(tmp_path / "s.zarr", "--targets", "1", "--bench", str(bench))
    run.until_pressing()
    # Like a terminal: to every process of the group.
    os.killpg(run.process.pid, signal.SIGINT)
    assert run.wait() == 130, run.text
    session = Session(run.session)
    assert session.status == "stopped"
    assert "interrupted by the operator" in session.attrs["reason"]
    assert "NOT RETRACTED" not in run.text
    assert f"to continue: tactile collect --resume {run.session} --bench {bench}" in run.text
    assert set(session.segments["outcome"]) == {OUTCOMES.index("complete")}
    frame = np.asarray(session.attrs["contact_frame"])
    last = np.asarray(session.streams["pose"].array("value"))[-1]
    assert last[2] - frame[2] > 0.015
    rows = len(session.streams["force"])

    again = CollectionRun.collect(run.session, "--resume", str(run.session), "--bench", str(bench))
    assert again.wait() == 0, again.text
    session = Session(run.session)
    assert session.status == "complete"
    assert len(session.runs) == 2
    assert len(session.streams["force"]) > rows
    assert faults_of(run.session) == []
    done = set(zip(session.segments["target"], session.segments["phase"], strict=True))
    assert len(done) == 4

    # A complete session is left as it is, to the last byte, and no emulator starts.
    before = {path: path.read_bytes() for path in run.session.rglob("*") if path.is_file()}
    assert main(["collect", "--resume", str(run.session), "--bench", str(bench)]) == 0
    assert "complete: all 1 targets are done" in capsys.readouterr().out.splitlines()[-1]
    after = {path: path.read_bytes() for path in run.session.rglob("*") if path.is_file()}
    assert after == before


@pytest.mark.slow
def test_targets_of_a_complete_session_are_pressed_again(
    collected: Collected, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = tmp_path / "s.zarr"
    shutil.copytree(collected[1].session, session)
    more = ("--resume", str(session), "--bench", str(patient_bench(tmp_path, "tacpalm")))
    assert main(["collect", *more, "--again", "3"]) == 2
    assert "--again: found 3; allowed: targets 1 to 2" in capsys.readouterr().err
    run = CollectionRun.collect(session, *more, "--again", "1")
    assert run.wait() == 0, run.text
    assert "complete: 2 of 2 targets" in run.lines[-1]
    assert len(Session(session).runs) == 2
    assert list(Session(session).segments["run"]).count(1) == 4
    # The press of the last run is the one that counts.
    recording = read_recording(session)
    pairs = zip(recording.column("target"), recording.column("run"), strict=True)
    assert {(int(target), int(run)) for target, run in pairs} == {(0, 1), (1, 0)}


@pytest.mark.slow
def test_the_soft_force_limit_ends_the_target_and_goes_on(tmp_path: Path) -> None:
    limits = {"force_rating_n": [12.0, 12.0, 0.4], "soft_fraction": 0.5, "hard_fraction": 5.0}
    limits |= {"horizon_ms": 20.0}
    # A skin that is stated too soft, so that no target is left out.
    soft = "skin: {modulus_kpa: [0.1, 0.1]}"
    bench = patient_bench(tmp_path, "tacpalm", limits=limits, more=soft)
    run = CollectionRun.collect(tmp_path / "s.zarr", "--targets", "2", "--bench", str(bench))
    assert run.wait() == 0, run.text
    limited = OUTCOMES.index("force_limited")
    assert list(Session(run.session).segments["outcome"]) == [limited, limited]
    assert "Fz" in run.text


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_twenty_kills_of_any_process_lose_nothing_and_sessions_are_resumed(tmp_path: Path) -> None:
    found = kill_often(tmp_path, kills=20, sessions=2, seed=1, targets=6)
    assert found.wrong == []
    assert found.lost == 0
    assert found.count == 20
    assert found.victims["everything"] >= 1
    assert found.completed >= 2
    assert found.resumed >= 18
    assert found.compared > 1000


@pytest.mark.slow
def test_beside_four_busy_processes_the_stated_uncertainty_covers_95_percent_of_the_errors(
    tmp_path: Path,
) -> None:
    bench = patient_bench(tmp_path, "tacpalm")
    # A loaded machine may lose a device while it starts, and nothing is recorded then.
    for attempt in range(5):
        session, truth = tmp_path / f"{attempt}.zarr", tmp_path / f"{attempt}.truth"
        busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(4)]
        try:
            options = ("--bench", str(bench), "--targets", "2", "--truth", str(truth))
            run = CollectionRun.collect(session, *options)
            code = run.wait(240)
        finally:
            for process in busy:
                process.kill()
                process.wait()
        if code == 0:
            break
        assert not session.exists() or Session(session).status == "stopped", run.text
    assert code == 0, run.text
    within = within_stated(session, truth)
    assert min(within.values()) >= 0.95, within
    assert (Session(session).frames["time_sigma"] > 0).all()
