"""The benchmark `faults`: its rows and parts end to end, and what its judgement lets pass."""

import argparse
import json
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from net.faults import rows_of
from support.collecting import ROOT
from support.sessions import make_session

from benchmarks.__main__ import main
from benchmarks.fake_clock import FakeClock
from benchmarks.faults import device_faults, endurance, kills, program_kills
from benchmarks.faults.device_faults import run_row
from benchmarks.faults.judge import RowResult, arm_in_words, complaints, losses, stored_in
from benchmarks.faults.kills import Kills
from benchmarks.faults.observer import ArmState, Observed
from benchmarks.faults.rows import QUICK, ROWS
from benchmarks.report import Page, Run
from recorder import Session, SessionError
from rig.bench.bench import BenchFile, bench_from
from rig.bench.guards import guard_limits
from rig.core.guard import ForceGuard, MotionGuard
from rig.core.packaged import BENCHES
from rig.core.samples import FORCE_LATEST, POSE_LATEST

MS = 1_000_000
SECOND = 1_000 * MS
BY_NAME = {row.name: row for row in ROWS}


@pytest.mark.serial
@pytest.mark.slow
def test_the_command_runs_a_row_and_writes_its_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_faults, "QUICK", ("force-duplicated",))
    out = tmp_path / "docs" / "faults.md"
    assert main(["faults", "--quick", "--only", "faults", "--out", str(out)]) == 0
    text = out.read_text()
    assert "1 of 1 faults ended as they must; 0 of " in text
    row = next(line for line in text.splitlines() if line.startswith("| force: duplicated"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[1:4] == ["continued, counted it", "-", "0"]
    assert cells[4].startswith("0 of ")
    assert int(cells[4].split()[-1]) > 100
    assert "force repeated" in cells[5]
    assert cells[6] == "still, clear"
    assert "127." not in text
    assert {path.name for path in out.parent.iterdir()} == {"faults.md", "faults.json"}


def test_the_rows_are_every_device_times_every_fault_and_those_of_the_net() -> None:
    assert len(BY_NAME) == len(ROWS)
    matrix = [
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
        assert {f"{device}-{fault}" for fault in matrix} <= set(BY_NAME)
    assert set(QUICK) <= set(BY_NAME)
    results = [asdict(RowResult(row.device, row.fault, 3, "stopped")) for row in ROWS]
    stored = {"faults": {"results": {"rows": results}}}
    assert set(rows_of(stored)) == set(json.loads((ROOT / "tests/net/faults.json").read_text()))


@pytest.fixture(name="session")
def small_session(tmp_path: Path) -> Path:
    return make_session(tmp_path / "s.zarr")


def test_a_sound_session_has_lost_nothing(session: Path) -> None:
    times = Session(session).streams["force"].t_ns
    observed = Observed(shown={"force": {int(t) for t in times[::50]}}, rows={"force": len(times)})
    assert losses(session, observed) == (len(times[::50]), 0)
    stored = stored_in(session)
    assert complaints(session, stored.disorder) == []
    assert stored.missing == stored.disorder == {"camera": 0, "force": 0, "pose": 0}


def test_samples_and_rows_that_were_shown_and_are_not_there_are_lost(session: Path) -> None:
    times = Session(session).streams["force"].t_ns
    shown = {int(times[0]), int(times[-1]), int(times[-1]) + 1}
    assert losses(session, Observed(shown={"force": shown})) == (3, 1)
    # A sample shown before recording began was not accepted.
    assert losses(session, Observed(shown={"force": {int(times[0]) - 1}})) == (0, 0)
    rows = len(Session(session).streams["pose"])
    assert losses(session, Observed(rows={"pose": rows + 7})) == (0, 7)


def forces(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Any:
    return lambda name, columns: change(columns) if name == "force" else columns


def test_what_is_missing_is_counted_by_the_devices_numbers(tmp_path: Path) -> None:
    def without_seven(columns: dict[str, Any]) -> dict[str, Any]:
        rows = np.delete(np.arange(len(columns["t_ns"])), slice(900, 907))
        return {name: [values[row] for row in rows] for name, values in columns.items()}

    stored = stored_in(make_session(tmp_path / "s.zarr", change=forces(without_seven)))
    assert stored.missing["force"] == 7
    assert stored.disorder["force"] == 0


def test_a_row_stored_twice_or_out_of_order_does_not_pass(tmp_path: Path) -> None:
    def swapped(columns: dict[str, Any]) -> dict[str, Any]:
        seq = np.array(columns["seq"])
        seq[500], seq[501] = seq[501], seq[500]
        seq[800] = seq[799]
        return {**columns, "seq": seq}

    path = make_session(tmp_path / "s.zarr", change=forces(swapped))
    stored = stored_in(path)
    assert stored.disorder["force"] == 2
    assert any("twice or out of order" in what for what in complaints(path, stored.disorder))


@pytest.mark.parametrize(
    ("state", "silent", "gone", "words", "standing"),
    [
        (ArmState(9 * SECOND, 0.02, 0.0), None, False, "still, clear", True),
        (ArmState(9 * SECOND, -0.001, 0.0), None, False, "still, at -1.0 mm", True),
        (ArmState(9 * SECOND, 0.02, 0.01), None, False, "MOVING, clear", False),
        (ArmState(2 * SECOND, 0.02, 0.0), None, False, "not known", False),
        (ArmState(2 * SECOND, 0.02, 0.0), 3 * SECOND, False, "still, clear", True),
        (ArmState(2 * SECOND, 0.02, 0.01), 3 * SECOND, False, "MOVING, clear", False),
        (ArmState(2 * SECOND, 0.02, 0.0), 6 * SECOND, False, "not known", False),
        (ArmState(2 * SECOND, 0.02, 0.0), 20 * SECOND, False, "not known", False),
        (None, 3 * SECOND, False, "not known", False),
        (None, None, True, "controller gone", True),
    ],
)
def test_an_arm_nobody_has_seen_standing_does_not_stand(
    state: ArmState | None, silent: int | None, gone: bool, words: str, standing: bool
) -> None:
    observed = Observed(arm=state, arm_silent_ns=silent)
    assert arm_in_words(observed, 10 * SECOND, gone) == (words, standing)


def test_the_page_says_what_is_wrong_and_what_was_not_run(session: Path) -> None:
    from benchmarks.faults.command import _summary

    result = RowResult("camera", "killed", 3, "gone", 0.25, 9, 2, "still", (), stored_in(session))
    killed = {
        "collections": asdict(Kills({"everything": 3}, compared=50, resumed=2, completed=1)),
        "programs": {"kills": {}, "rows": 7, "wrong": []},
        "disks": 0,
        "no_disk": "no root",
    }

    def page(result: RowResult) -> str:
        values = {"rows": [asdict(result)], "skipped": {"disk-full": "needs root"}}
        sections = (
            device_faults.section(values, Page(session)),
            kills.section(killed, Page(session)),
        )
        return "\n".join([_summary({"faults": values, "kills": killed}), *sections])

    good = page(result)
    assert "1 of 1 faults ended as they must; 2 of 9 accepted" in good
    assert "3 kills and 0 full disks: 0 failures" in good
    assert "after 400 ms without a force sample (lab: 50 ms)" in " ".join(good.split())
    assert "Not run: disk-full: needs root" in good
    assert "a tmpfs needs root: no root" in good
    bad = page(replace(result, wrong=("2 accepted samples are missing",)))
    assert "0 of 1 faults ended" in bad
    assert "- camera killed: 2 accepted samples are missing" in bad


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
@pytest.mark.parametrize("name", BY_NAME)
def test_every_row_is_as_it_should_be(name: str, tmp_path: Path) -> None:
    try:
        assert run_row(BY_NAME[name], tmp_path)["wrong"] == ()
    except program_kills.CannotMount as error:
        pytest.skip(f"no tmpfs can be mounted: {error}")


def test_a_chain_of_kills_loses_nothing(tmp_path: Path) -> None:
    killed: Counter[str] = Counter()
    assert program_kills.kill_in_turn(tmp_path, random.Random(1), killed) > 0
    assert sum(killed.values()) >= 1
    assert Session(tmp_path / "s.zarr").status in ("recovered", "complete")


def test_a_missing_or_changed_row_is_a_failure(tmp_path: Path) -> None:
    session = program_kills.Numbered(tmp_path / "s.zarr")
    session.write(limit=3)
    session.compare("writing")
    session.accepted[1] = 1000
    with pytest.raises(program_kills.Loss, match="force: 1000 rows accepted, 48 stored"):
        session.compare("writing")
    wrong: list[str] = []

    def lost(_: Path) -> int:
        raise SessionError("gone")

    assert kills.in_scratch(tmp_path, lost, wrong) == 0
    assert wrong == ["gone"]


def test_the_long_plan_takes_half_an_hour(tmp_path: Path) -> None:
    bench = BenchFile.read(endurance.long_bench(tmp_path)).bench
    walked = bench.dry_run(bench.trajectory)
    assert walked.broken == ()
    assert 1800.0 <= walked.duration < 1900.0


def test_a_leak_shows_as_its_slope_and_the_warm_up_does_not() -> None:
    times = np.arange(0.0, 1800.0, 5.0)
    filling = 50e6 * np.minimum(times / 60.0, 1.0)
    memory = 100e6 + filling + 2e6 * times / 3600.0
    rows = [(t, used, 7) for t, used in zip(times, memory, strict=True)]
    growth = endurance.growth_of(endurance.Track("x", rows))
    assert growth is not None
    assert growth["slope"] == pytest.approx(2e6, rel=1e-6)
    assert growth["last"] - growth["first"] == pytest.approx(2e6 * (1735 - 145) / 3600, abs=1e5)
    assert endurance.growth_of(endurance.Track("y", [(150.0, 1, 1), (155.0, 1, 1)])) is None


@pytest.mark.serial
@pytest.mark.slow
def test_a_short_long_run_tracks_every_process_and_says_what_was_recorded(tmp_path: Path) -> None:
    run = Run(argparse.Namespace(quick=True), tmp_path, lambda fraction: None)
    values = endurance.measure(run)
    assert run.failures == []
    roles = set(values["processes"])
    wanted = {"collect", "arm", "World", "arm emulator", "force emulator", "camera emulator"}
    assert wanted | {"force stream", "pose stream", "camera stream"} <= roles
    assert all(each["first"] > 1 << 20 for each in values["growth"])
    text = endurance.section(values, Page(tmp_path / "faults.md"))
    assert "exit code 0" in text
    assert "| force |" in text
