"""The reliability benchmark: one row end to end, and checks of its criteria."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.sessions import make_session

from benchmarks.__main__ import main
from benchmarks.faults import disk
from benchmarks.faults.judge import FaultResult, arm_in_words, complaints, left_in, losses
from benchmarks.faults.kills import VICTIMS, Kills
from benchmarks.faults.observer import ArmState, Seen
from benchmarks.faults.page import page
from benchmarks.faults.rows import ROWS
from benchmarks.faults.run import Results, names
from recorder import Session
from rig.bench.bench import BenchFile, bench_from
from rig.bench.guards import guard_limits
from rig.core.clock import FakeClock
from rig.core.guard import ForceGuard, MotionGuard
from rig.core.packaged import BENCHES
from rig.core.samples import FORCE_LATEST, POSE_LATEST

MS = 1_000_000
SECOND = 1_000 * MS


@pytest.mark.serial
@pytest.mark.slow
def test_the_command_runs_a_row_and_writes_its_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "docs" / "reliability.md"
    arguments = ["--only", "force-duplicated", "--benches", str(BENCHES), "--out", str(out)]
    assert main(["faults", *arguments]) == 0
    assert "force-duplicated: exit 0" in capsys.readouterr().out
    text = out.read_text()
    row = next(line for line in text.splitlines() if line.startswith("| duplicated"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[1] == "continued, counted it"
    assert cells[3] == "0"
    assert cells[5].startswith("0 of ")
    assert int(cells[5].split()[-1]) > 100
    assert "force repeated" in cells[7]
    assert cells[8] == "still, clear"
    assert "Every row passed" in text
    assert "127." not in text
    assert [path.name for path in out.parent.iterdir()] == ["reliability.md"]


def test_a_row_that_is_none_is_refused_with_those_that_are(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["faults", "--only", "force-melted", "--benches", str(BENCHES)]) == 2
    assert "known: arm-killed" in capsys.readouterr().err
    assert main(["faults", "--kills", "-1", "--benches", str(BENCHES)]) == 2
    assert main(["faults", "--benches", "nowhere"]) == 2


def test_the_rows_are_every_device_times_every_fault_and_more(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["faults", "--list"]) == 0
    listed = capsys.readouterr().out.split()
    assert listed == names()
    assert len(set(listed)) == len(listed)
    faults = [
        "killed",
        "unplugged",
        "frozen-3-s",
        "slow",
        "garbage",
        "wrong-units",
        "reordered",
        "duplicated",
    ]
    for device in ("arm", "force", "camera", "taxels"):
        assert {f"{device}-{fault}" for fault in faults} <= set(listed)
    assert {"disk-full", "kills", "arm-protective-stop", "force-overload"} <= set(listed)


@pytest.fixture(name="session")
def small_session(tmp_path: Path) -> Path:
    return make_session(tmp_path / "s.zarr")


def test_a_sound_session_has_lost_nothing(session: Path) -> None:
    times = Session(session).streams["force"].t_ns
    seen = Seen(shown={"force": {int(t) for t in times[::50]}}, rows={"force": len(times)})
    assert losses(session, seen) == (len(times[::50]), 0)
    left = left_in(session)
    assert complaints(session, left) == []
    assert left.missing == left.disorder == {"camera": 0, "force": 0, "pose": 0}


def test_a_sample_that_was_shown_and_is_not_there_is_lost(session: Path) -> None:
    times = Session(session).streams["force"].t_ns
    shown = {int(times[0]), int(times[-1]), int(times[-1]) + 1}
    assert losses(session, Seen(shown={"force": shown})) == (3, 1)
    # A sample shown before recording began was not accepted.
    assert losses(session, Seen(shown={"force": {int(times[0]) - 1}})) == (0, 0)


def test_rows_that_were_stored_and_are_not_there_are_lost(session: Path) -> None:
    rows = len(Session(session).streams["pose"])
    assert losses(session, Seen(rows={"pose": rows + 7})) == (0, 7)


def planted(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Any:
    return lambda name, columns: change(columns) if name == "force" else columns


def test_what_is_missing_is_counted_by_the_devices_numbers(tmp_path: Path) -> None:
    def without_seven(columns: dict[str, Any]) -> dict[str, Any]:
        keep = np.delete(np.arange(len(columns["t_ns"])), slice(900, 907))
        return {name: [values[row] for row in keep] for name, values in columns.items()}

    path = make_session(tmp_path / "s.zarr", change=planted(without_seven))
    assert left_in(path).missing["force"] == 7
    assert complaints(path, left_in(path)) == []


def test_a_row_stored_twice_or_out_of_order_is_not_let_pass(tmp_path: Path) -> None:
    def swapped(columns: dict[str, Any]) -> dict[str, Any]:
        seq = np.array(columns["seq"])
        seq[500], seq[501] = seq[501], seq[500]
        seq[800] = seq[799]
        return {**columns, "seq": seq}

    path = make_session(tmp_path / "s.zarr", change=planted(swapped))
    left = left_in(path)
    assert left.disorder["force"] == 2
    assert any("twice or out of order" in what for what in complaints(path, left))


@pytest.mark.parametrize(
    ("states", "silent", "gone", "words", "standing"),
    [
        ([ArmState(9 * SECOND, 0.02, 0.0)], None, False, "still, clear", True),
        ([ArmState(9 * SECOND, -0.001, 0.0)], None, False, "still, at -1.0 mm", True),
        ([ArmState(9 * SECOND, 0.02, 0.01)], None, False, "MOVING, clear", False),
        ([ArmState(2 * SECOND, 0.02, 0.0)], None, False, "not known", False),
        ([ArmState(2 * SECOND, 0.02, 0.0)], 3 * SECOND, False, "still, clear", True),
        ([ArmState(2 * SECOND, 0.02, 0.01)], 3 * SECOND, False, "MOVING, clear", False),
        ([ArmState(2 * SECOND, 0.02, 0.0)], 6 * SECOND, False, "not known", False),
        ([ArmState(2 * SECOND, 0.02, 0.0)], 20 * SECOND, False, "not known", False),
        ([], 3 * SECOND, False, "not known", False),
        ([], None, True, "controller gone", True),
    ],
)
def test_an_arm_nobody_has_seen_standing_does_not_stand(
    states: list[ArmState], silent: int | None, gone: bool, words: str, standing: bool
) -> None:
    seen = Seen(arm=states, arm_silent_ns=silent)
    assert arm_in_words(seen, 10 * SECOND, gone) == (words, standing)


def test_the_page_says_what_is_wrong_and_what_was_not_run(session: Path) -> None:
    row = next(row for row in ROWS if row.name == "camera-killed")
    judged = FaultResult(
        3, "stopped (camera: gone; check it): 0 of 2", 0.25, left_in(session), 9, 2, "still", ()
    )
    kills = Kills(completed=1, compared=50, resumed=2)
    kills.victims[VICTIMS[0]] = 3
    results = Results(rows=[(row, judged)], kills=kills)
    good = page(results, BENCHES)
    assert "Every row passed" in good
    assert "2 of 9" in good
    assert "## 3 kills" in good
    assert "| no force sample for | 50 ms | 400 ms |" in good
    results.rows = [(row, replace(judged, wrong=("2 accepted samples are not there",)))]
    results.skipped = [(disk.ROW.name, "needs root")]
    bad = page(results, BENCHES)
    assert "Every row passed" not in bad
    assert "camera-killed: 2 accepted samples are not there" in bad
    assert "Not run: disk-full: needs root" in bad


def test_a_labs_stale_limits_are_50_and_100_ms_and_stop_the_arm_just_past_them() -> None:
    content = BenchFile.read(BENCHES / "tacpalm.yaml").content
    for key in ("stale_force_ms", "stale_pose_ms"):
        del content["limits"][key]
    bench = bench_from(content, "a lab's bench")
    limits = replace(guard_limits(bench), box=((-9.0,) * 3, (9.0,) * 3))
    clock = FakeClock(10 * SECOND)
    force, pose = np.zeros(1, FORCE_LATEST), np.zeros(1, POSE_LATEST)
    pose["safety_status"] = 1

    def stop_reason(force_age_ns: int, pose_age_ns: int) -> str | None:
        force["t_ns"], pose["t_ns"] = clock.now_ns() - force_age_ns, clock.now_ns() - pose_age_ns
        reasons = (
            ForceGuard(limits).check(clock.now_ns(), force, "guarded"),
            MotionGuard(limits, np.zeros(6)).check(clock.now_ns(), pose, "guarded"),
        )
        return next((reason.kind for reason in reasons if reason is not None), None)

    assert stop_reason(50 * MS, 100 * MS) is None
    assert stop_reason(50 * MS + 1, 100 * MS) == "stale_force"
    assert stop_reason(50 * MS, 100 * MS + 1) == "stale_pose"


@pytest.mark.serial
@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in names() if name not in ("kills", "disk-full")])
def test_every_row_is_as_it_should_be(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = main(["faults", "--only", name, "--benches", str(BENCHES)])
    assert code == 0, capsys.readouterr().out


@pytest.mark.serial
@pytest.mark.slow
def test_a_full_disk_loses_nothing(tmp_path: Path) -> None:
    try:
        judged = disk.fill_disk(tmp_path, BENCHES)
    except disk.CannotMount as error:
        pytest.skip(f"no tmpfs can be mounted: {error}")
    assert judged.wrong == ()
    assert judged.code == 3


def test_victims_are_drawn_from_everybody() -> None:
    rng = random.Random(0)
    assert {rng.choice(VICTIMS) for _ in range(200)} == set(VICTIMS)
