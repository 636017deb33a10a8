"""A day of sessions: complete sessions are kept, interrupted ones resume, however they ended."""

import contextlib
import dataclasses
import io
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.collecting import ROOT, faults_of, pressed_session

from benchmarks.faults.collection_run import CollectionRun, quick_bench
from recorder import Session
from recorder import catalogue as catalogue_module
from recorder.session.press_curve import press_curves
from rig.acquire import campaign as campaign_module
from rig.acquire.campaign import Campaign, Item, Progress, load_campaign, progress_of, table
from rig.cli import campaign as campaign_command
from rig.cli import force_depth
from rig.cli.campaign import record_entry, run_campaign
from rig.cli.recording import Recording
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES, CAMPAIGNS
from rig.devices.gripper.settings import RobotiqConfig
from tactile.__main__ import main

DAY = """
out: {out}
operator: ada
sessions:
  - {{sensor: gelsight, indenter: prism, plan: force_depth}}
  - {{sensor: gelsight, indenter: cylinder, targets: 2}}
  - {{sensor: uskin, indenter: cylinder, targets: 1}}
"""


def _campaign(folder: Path, text: str = DAY) -> Campaign:
    path = folder / "day.yaml"
    path.write_text(text.format(out=folder / "out"))
    return load_campaign(path, BENCHES)


def _session(path: Path, item: Item, done: int, status: str, sensor: str = "") -> None:
    named = {"sensor": sensor or item.entry.sensor, "indenter": item.entry.indenter}
    pressed_session(path, item.plan, item.total, done, status, **named)


def _file(folder: Path, *entries: str) -> Campaign:
    """Return the campaign of a file with these sessions, whose bench files lie beside it."""
    file = folder / "plan.yaml"
    file.write_text("\n".join(["sessions:", *(f"  - {{{entry}}}" for entry in entries)]))
    return dataclasses.replace(load_campaign(file, folder), out=folder / "out")


def _in_the_lab(campaign: Campaign, **bench: Any) -> Campaign:
    lab = {"mock": False, "world": None, **bench}
    items = tuple(
        dataclasses.replace(item, bench=dataclasses.replace(item.bench, **lab))
        for item in campaign.items
    )
    return dataclasses.replace(campaign, items=items)


class _Bench:
    """Mock of the recording command: writes sessions, as far as the test specifies."""

    def __init__(self, campaign: Campaign, codes: list[int]) -> None:
        self.items = {f"{item.name}.zarr": item for item in campaign.items}
        self.codes = codes
        self.ran: list[Progress] = []

    def __call__(self, progress: Progress) -> int:
        self.ran.append(progress)
        code = self.codes.pop(0)
        path = progress.session
        item = self.items[path.name]
        if progress.state == "to resume":
            path.rename(path.with_suffix(".before"))
        _session(path, item, item.total if code == 0 else 1, "stopped" if code else "complete")
        return code


def _run(
    campaign: Campaign, codes: list[int], **options: Any
) -> tuple[int, list[Progress], list[str], list[str]]:
    bench = _Bench(campaign, codes)
    asked: list[str] = []

    def ask(question: str) -> bool:
        asked.append(question)
        return True

    with contextlib.redirect_stdout(io.StringIO()) as printed:
        code = run_campaign(campaign, bench, ask, **options)
    return code, bench.ran, asked, printed.getvalue().splitlines()


def test_everything_is_recorded_in_order_after_a_question_for_each_swap(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path)
    code, ran, asked, reported = _run(campaign, [0, 0, 0])
    assert code == 0
    plans = [progress.item.entry.plan for progress in ran]
    assert plans == ["force_depth", "press_shear", "press_shear"]
    assert "indenter prism" in asked[0]
    assert "sensor uskin" in asked[2]
    assert ran[1].item.entry.targets == 2
    assert reported[-1].startswith("3 of 3 sessions done")
    code, ran, asked, _ = _run(campaign, [])
    assert (code, ran, asked) == (0, [], [])


@pytest.mark.parametrize("failure", [3, 4, 130])
def test_what_stopped_goes_on_from_where_it_was(tmp_path: Path, failure: int) -> None:
    campaign = _campaign(tmp_path)
    code, ran, _, reported = _run(campaign, [0, failure], go_on="tactile campaign --file day.yaml")
    assert (code, len(ran)) == (failure, 2)
    assert reported[-1] == "to continue: tactile campaign --file day.yaml"
    assert any("1/2" in line and "to resume" in line for line in reported)
    code, ran, _, _ = _run(campaign, [0, 0])
    assert code == 0
    assert [progress.state for progress in ran] == ["to resume", "open"]


def test_keep_going_passes_a_failure_but_not_ctrl_c(tmp_path: Path) -> None:
    code, ran, _, _ = _run(_campaign(tmp_path), [4, 130], keep_going=True)
    assert (code, len(ran)) == (4, 2)


def test_a_technician_who_says_no_ends_it_before_anything_moves(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path)
    bench = _Bench(campaign, [])
    assert run_campaign(campaign, bench, lambda _: False) == 130
    assert bench.ran == []


def test_a_gripper_is_waited_for_and_only_the_sensor_asked_for(tmp_path: Path) -> None:
    campaign = _in_the_lab(_campaign(tmp_path), gripper=RobotiqConfig("/dev/none"))
    record = _Bench(campaign, [0, 0, 0])
    events: list[str] = []

    def ask(question: str) -> bool:
        events.append(question)
        return True

    def swap(item: Item) -> None:
        events.append(f"gripper: {item.entry.indenter}")

    assert run_campaign(campaign, record, ask, swap) == 0
    assert [event.partition("\n")[0] for event in events] == [
        "1 of 3: mount sensor gelsight",
        "gripper: prism",
        "gripper: cylinder",
        "3 of 3: mount sensor uskin",
        "gripper: cylinder",
    ]
    # The motion of a lab bench is stated before it is agreed to.
    assert "mm/s near the sensor" in events[0]


def test_a_session_of_another_sensor_in_its_place_is_not_touched(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path)
    first, _, last = campaign.items
    _session(tmp_path / "out" / f"{first.entry.name}.zarr", last, 1, "complete")
    assert progress_of(campaign)[0].state == "unreadable"
    code, ran, _, reported = _run(campaign, [0, 0])
    assert (code, ran) == (2, [])
    assert "move it away" in reported[0]
    code, ran, _, _ = _run(campaign, [0, 0], keep_going=True)
    assert (code, len(ran)) == (2, 2)


def test_benches_with_names_of_their_own_are_recorded_in_the_simulated_world_and_listed_as_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "twin-1.yaml").write_text("extends: gelsight.yaml\nindenter: line\n")
    campaign = _file(tmp_path, "sensor: twin-1, indenter: line, targets: 1")
    (item,) = campaign.items

    def collected(recording: Recording, *, targets: int | None) -> int:
        assert recording.bench.world is not None
        assert recording.bench.world.tier == "layer"
        assert (recording.bench.indenter, targets) == ("line", 1)
        assert recording.out is not None
        _session(recording.out, item, 1, "complete", item.bench.sensor)
        return 0

    monkeypatch.setattr(campaign_command, "collect", collected)

    def record(progress: Progress) -> int:
        return record_entry(progress, "", ROOT / "calibrations", "sim")

    assert run_campaign(campaign, record, lambda _: True) == 0
    assert [progress.state for progress in progress_of(campaign)] == ["done"]


def test_benches_of_one_sensor_ask_to_mount_the_sensor_and_indenter_and_not_the_bench(
    tmp_path: Path,
) -> None:
    for name, depth in (("twin-1", 0.6), ("twin-2", 0.9), ("twin-3", 0.9)):
        (tmp_path / f"{name}.yaml").write_text(
            f"extends: gelsight.yaml\ntrajectory: {{depth_max_mm: {depth}}}\n"
        )
    names = (("twin-1", "line"), ("twin-2", "line"), ("twin-3", "sphere"))
    campaign = _file(tmp_path, *(f"sensor: {one}, indenter: {other}" for one, other in names))

    def asked(campaign: Campaign) -> list[str]:
        questions: list[str] = []

        def ask(question: str) -> bool:
            questions.append(question)
            return True

        run_campaign(campaign, lambda _: 0, ask)
        return questions

    told = asked(_in_the_lab(campaign))
    assert [question.partition("\n")[0] for question in told] == [
        "1 of 3: mount sensor gelsight, indenter line (bench file twin-1)",
        "2 of 3: keep sensor gelsight, indenter line (bench file twin-2)",
        "3 of 3: mount sensor gelsight, indenter sphere (bench file twin-3)",
    ]
    # The same indenter goes deeper on the second bench; the campaign asks before it moves.
    assert told[0].partition("\n")[2] != told[1].partition("\n")[2]
    assert [question.partition(" (")[0] for question in asked(campaign)] == [
        "1 of 3: mount sensor gelsight, indenter line",
        "3 of 3: mount sensor gelsight, indenter sphere",
    ]


def test_a_simulated_world_is_refused_before_anything_is_asked(tmp_path: Path) -> None:
    (tmp_path / "bare.yaml").write_text("extends: gelsight.yaml\nmock: false\nworld: null\n")
    _file(tmp_path, "sensor: bare, indenter: line, targets: 1")
    words = [
        "--file",
        str(tmp_path / "plan.yaml"),
        "--benches",
        str(tmp_path),
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(["campaign", *words, "--world", "sim", "--yes"]) == 2
    assert not (tmp_path / "out").exists()


def test_the_same_sensor_indenter_and_plan_are_recorded_more_than_once(tmp_path: Path) -> None:
    entry = "  - {{sensor: uskin, indenter: cylinder, targets: 1}}\n"
    campaign = _campaign(tmp_path, "out: {out}\nsessions:\n" + 3 * entry)
    code, ran, asked, _ = _run(campaign, [0, 0, 0])
    assert (code, len(ran), len(asked)) == (0, 3, 1)
    names = {path.name for path in (tmp_path / "out").glob("*.zarr")}
    first = "uskin-cylinder-press-shear-1"
    assert names == {f"{first}{again}.zarr" for again in ("", "-again-2", "-again-3")}


@pytest.mark.parametrize("count", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_a_day_reads_each_session_once(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entry = "  - {{sensor: uskin, indenter: cylinder, targets: 1}}\n"
    campaign = _campaign(tmp_path, "out: {out}\nsessions:\n" + count * entry)
    read: list[str] = []
    original = catalogue_module._read

    item = campaign.items[0]
    # What a campaign reads of a complete session.
    attrs = {"format": "tactile-rig session", "status": "complete", "targets_wanted": item.total}
    attrs |= {"sensor": item.entry.sensor, "indenter": item.entry.indenter}

    def record(progress: Progress) -> int:
        progress.session.mkdir()
        (progress.session / "zarr.json").write_text(json.dumps({"attributes": attrs}))
        return 0

    def look(folder: Path, path: str, stamp: tuple[int, int, int]) -> catalogue_module.Row:
        read.append(path)
        return original(folder, path, stamp)

    monkeypatch.setattr(catalogue_module, "_read", look)
    monkeypatch.setattr(campaign_module, "Session", None)  # no session has to be opened
    assert run_campaign(campaign, record, lambda _: True) == 0
    assert all(progress.state == "done" for progress in progress_of(campaign))
    assert len(read) == len(set(read)) == count


def test_time_left_shrinks_with_what_is_done(tmp_path: Path) -> None:
    campaign = _campaign(tmp_path)
    before = sum(progress.left for progress in progress_of(campaign))
    item = campaign.items[1]
    _session(tmp_path / "out" / f"{item.entry.name}.zarr", item, 1, "stopped")
    found = progress_of(campaign)
    assert found[1].done == 1
    assert 0 < sum(progress.left for progress in found) < before
    assert "0 of 3 sessions done" in table(found)[-1]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sessions: []\n", "a list of sessions"),
        ("sessions: [{{sensor: gelsight, indenter: ../x}}]\n", "letters, digits"),
        ("sessions: [{{sensor: gelsight, indenter: cone, targets: 999}}]\n", "1 to 240"),
        (
            "sessions: [{{sensor: gelsight, indenter: bananna}}]\n",
            r"sessions\[0\]\.indenter: found 'bananna'; known",
        ),
        ("sessions: [{{sensor: gelsight, indenter: cylindr}}]\n", r"did you mean cylinder\?"),
    ],
)
def test_a_campaign_that_cannot_be_run_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        _campaign(tmp_path, text)


def test_the_example_is_runnable_and_listing_records_nothing(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "none"
    day = CAMPAIGNS / "day.yaml"
    arguments = ["--file", str(day), "--benches", str(BENCHES), "--out", str(out), "--list"]
    assert main(["campaign", *arguments]) == 0
    assert "0 of 8 sessions done" in capsys.readouterr().out
    assert not out.exists()


def test_without_a_terminal_it_does_not_guess_that_something_is_mounted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _campaign(tmp_path)
    with open(os.devnull) as nothing:
        monkeypatch.setattr(sys, "stdin", nothing)
        assert main(["campaign", "--file", str(tmp_path / "day.yaml")]) == 2
    assert "no terminal to ask on" in capsys.readouterr().err


def test_an_entry_is_recorded_with_its_bench_session_and_operator_or_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pressed: list[Recording] = []
    resumed: list[tuple[Recording, dict[str, Any]]] = []
    monkeypatch.setattr(force_depth, "press", lambda recording: pressed.append(recording) or 0)
    monkeypatch.setattr(
        campaign_command,
        "collect",
        lambda recording, **more: resumed.append((recording, more)) or 3,
    )
    campaign = _campaign(tmp_path)
    first, second, _ = progress_of(campaign)
    assert record_entry(first, campaign.operator, tmp_path / "cal", None) == 0
    (recording,) = pressed
    assert (recording.bench.indenter, recording.operator) == ("prism", "ada")
    assert (recording.out, recording.calibrations) == (first.session, tmp_path / "cal")
    # The question was asked when the indenter was mounted.
    assert recording.agreed
    _session(second.session, second.item, 1, "stopped")
    stopped = dataclasses.replace(second, state="to resume", again=(2,))
    assert record_entry(stopped, "ada", tmp_path / "cal", None) == 3
    assert resumed[0][1] == {"resumed": second.session, "again": (1,)}


@pytest.mark.slow
def test_a_campaign_killed_in_the_middle_goes_on_and_loses_nothing(tmp_path: Path) -> None:
    for sensor in ("gelsight", "uskin"):
        more = "force_depth: {kind: force_depth, depth_max_mm: 1.0, repeats: 3}"
        quick_bench(tmp_path, sensor, more=more).rename(tmp_path / f"{sensor}.yaml")
    _campaign(
        tmp_path, DAY.replace("  - {{sensor: gelsight, indenter: cylinder, targets: 2}}\n", "")
    )
    words = ("campaign", "--file", str(tmp_path / "day.yaml"), "--yes")
    words += ("--benches", str(tmp_path), "--calibrations", str(tmp_path / "none"))
    first = tmp_path / "out" / "gelsight-prism-force-depth.zarr"
    run = CollectionRun(first, *words)
    run.until_pressing()
    run.kill_all()

    again = CollectionRun(first, *words)
    assert again.wait(240) == 0, again.text
    assert "2 of 2 sessions done" in again.text
    session = Session(first)
    assert session.status == "complete"
    assert len(session.runs) == 2
    assert faults_of(first) == []
    assert set(np.asarray(session.segments["target"])) == {0, 1, 2}
    curves = press_curves(session)
    # Hysteresis: unloading returns only part of the work done by loading.
    assert (curves.work(curves.loading) > curves.work(curves.unloading)).all()
