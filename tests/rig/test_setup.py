"""The set-up goes on where it stopped, and its acceptance goes with every session."""

import argparse
import dataclasses
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from recorder import Session
from rig.acquire.calibration import store
from rig.acquire.calibration.store import Calibration
from rig.acquire.doctor import Finding
from rig.bench.bench import BenchFile, bench_from
from rig.bench.guards import without_gauge
from rig.cli import setup
from rig.cli.home import find_by_force
from rig.core.errors import ConfigError, DeviceLost
from rig.core.packaged import BENCHES

BENCH = BENCHES / "gelsight.yaml"


def parsed(folder: Path, *more: str, bench: str = f"--bench={BENCH}") -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    setup.add_arguments(parser)
    options = parser.parse_args([bench, "--calibrations", str(folder), *more])
    options.out = folder / "sessions"
    return options


LAB = "mock: false\nworld: null\n"
WEIGHT, LENGTH = (
    next(ask for step in setup.STEPS for ask in step.asks if ask.name == name)
    for name in ("weight_g", "length_mm")
)


class Steps:
    """Two steps, whose findings a test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.run: list[Any] = []
        self.monkeypatch = monkeypatch
        self.state = "well"
        self.lost = False

        def first(at: setup.AtBench, answers: setup.Answers) -> Iterator[Finding]:
            """Is the first part well?"""
            self.run.append(("first", *answers.values()))
            yield Finding("part", "well", "<b>well</b>")

        def second(at: setup.AtBench, answers: setup.Answers) -> Iterator[Finding]:
            """Is the second part well?"""
            self.run.append("second")
            if not at.bench.mock:
                at.do("lead the tip to the surface")
            at.record.keep_picture("camera.jpeg", b"a picture")
            if self.lost:
                raise DeviceLost("the gauge is gone")
            yield Finding("part", self.state, "found", ("a cure",))  # type: ignore[arg-type]

        steps = (setup.Step(first, ("force",), (WEIGHT, LENGTH)), setup.Step(second, ("camera",)))
        monkeypatch.setattr(setup, "STEPS", steps)

    def answers(self, *typed: Any) -> list[str]:
        """Type these answers, None for Ctrl-D; return the questions as they are asked."""
        left, asked = list(typed), list[str]()

        def answer(prompt: str) -> str | None:
            asked.append(prompt.strip())
            if left and left[0] is KeyboardInterrupt:
                raise left.pop(0)
            typed: str | None = left.pop(0)
            return typed

        self.monkeypatch.setattr(setup, "answer", answer)
        self.monkeypatch.setattr(setup, "require_terminal", lambda: None)
        return asked


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> Steps:
    return Steps(monkeypatch)


def test_a_stopped_set_up_goes_on_and_ends_in_a_report_that_sessions_carry(
    steps: Steps, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = BenchFile.read(BENCH)
    bench, content = file.bench, file.content
    steps.state = "FAULT"
    assert setup.run(parsed(tmp_path, "--yes")) == 3
    assert "stopped at second; the same command goes on" in capsys.readouterr().out
    assert store.acceptance_of(tmp_path, bench) is None

    steps.run, steps.state = [], "note"
    assert setup.run(parsed(tmp_path, "--yes", "--operator", "Ada")) == 0
    assert steps.run == ["second"]
    report = tmp_path / "gelsight.acceptance.html"
    text = capsys.readouterr().out
    assert "1/2 first: done" in text
    assert f"setup: accepted; report: {report}; next: tactile collect --bench {BENCH}" in text
    page = report.read_text()
    assert "&lt;b&gt;well&lt;/b&gt;" in page
    assert "weight_g 100.0" in page
    assert "data:image/jpeg;base64,YSBwaWN0dXJl" in page
    assert "http" not in page

    calibration, _ = store.load(tmp_path, bench, bench.indenter)
    accepted = calibration.attrs()["acceptance"]
    assert accepted["result"] == "accepted"
    assert calibration.lines()[0].startswith("bench    accepted, 20")
    assert accepted["operator"] == "Ada"
    assert accepted["steps"] == {"first": "well", "second": "note"}
    assert accepted["bench_sha256"] == store.bench_hash(content)
    stored = json.loads((tmp_path / "gelsight.setup.json").read_text())
    assert accepted["steps_sha256"] == store.bench_hash(stored["steps"])
    assert accepted["steps_sha256"][:16] in page
    assert Calibration.from_attrs(json.loads(json.dumps(calibration.attrs()))) == calibration

    steps.run = []
    assert setup.run(parsed(tmp_path, "--yes", "--again", "first")) == 0
    assert steps.run == [("first", 100.0, 100.0)]


def test_a_step_repeats_once_its_part_of_the_bench_changes(steps: Steps, tmp_path: Path) -> None:
    file = tmp_path / "bench.yaml"
    for rate, run in ((1000, 2), (500, 1), (500, 0)):
        file.write_text(f"extends: {BENCH}\nforce: {{rate_hz: {rate}}}\n")
        steps.run = []
        assert setup.run(parsed(tmp_path, "--yes", bench=f"--bench={file}")) == 0
        assert len(steps.run) == run


# Answers in turn: mass, length, and Enter once the tip is led to the surface; then a decision on a
# fault. With words that are printed, the exit code, and the answers that the first step had.
STOPPED = "setup: stopped; the same command goes on from there, and offers the answers given so far"
TYPED: dict[str, tuple[list[Any], str, int, tuple[float, ...]]] = {
    "a mass of -100": (["-100", "50", "", ""], "weight_g: found '-100'; allowed: 1 to 1472", 0, ()),
    "a mass of 0": (
        ["0", "50", "", ""],
        "found '0'; allowed: 1 to 1472 by the guard's limit",
        0,
        (),
    ),
    "a mass of abc": (["abc", "50", "", ""], "found 'abc'; allowed: 1 to 1472 by the", 0, ()),
    "a comma": (["50,5", "50", "", ""], "a number with a decimal point; write 50.5", 0, ()),
    "its unit": (["50 g", "50", "", ""], "a number with a decimal point; write 50", 0, ()),
    "kg": (["0.05", "50", "", ""], "is it in kg? then write 50", 0, ()),
    "a folder for a number": (["~", "50", "", ""], "weight_g: found '~'; allowed: 1 to", 0, ()),
    "10 for cm": (["50", "10", "", ""], "length_mm: found '10'; allowed: 33.3 to 1000", 0, ()),
    "cm are named": (["50", "10", "", ""], "is it in cm? then write 100", 0, ()),
    "0.1 for m": (["50", "0.1", "", ""], "is it in m? then write 100", 0, ()),
    "an empty line": (["", "", ""], "setup: accepted; report", 0, (100.0, 100.0)),
    "a pose of 3": (["50", "", "1 2 3", ""], "found '1 2 3'; allowed: Enter alone", 0, ()),
    "a pose of 7": (["50", "", "1 2 3 4 5 6 7", ""], "poses and forces are read from", 0, ()),
    "stop instead of Enter": (["50", "", "stop"], STOPPED, 130, ()),
    "Ctrl-C": (["50", KeyboardInterrupt], STOPPED, 130, ()),
    "Ctrl-D": (["50", None], STOPPED, 130, ()),
    "a choice that is none": (["50", "", "", "a", "stop"], "found 'a'; allowed: Enter to ", 3, ()),
    "two lines": (["50", "", "", "accept\naccept", "stop"], "found 'accept\\naccept'", 3, ()),
    "stop": (["50", "", "", "stop"], "setup: stopped at second; the same command goes", 3, ()),
    "accept": (["50", "", "", " accept "], "setup: accepted with faults: second", 0, ()),
    "skip": (["50", "", "", "skip"], "no report yet, skipped: second; the same", 3, ()),
    "measure again": (["50", "", "", "", "", "skip"], "no report yet, skipped: second", 3, ()),
}


@pytest.mark.parametrize("name", TYPED)
def test_an_answer_is_taken_or_named_and_none_before_it_is_lost(
    steps: Steps, name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text(f"extends: {BENCH}\n{LAB}")
    typed, words, code, answers = TYPED[name]
    steps.state = "FAULT" if code == 3 or name == "accept" else "well"
    asked = steps.answers(*typed)
    assert setup.run(parsed(tmp_path, bench=f"--bench={lab}")) == code
    assert words in capsys.readouterr().out
    assert len(asked) == len(typed)
    if code:
        steps.answers("", "", "", "")
        steps.state = "well"
        assert setup.run(parsed(tmp_path, bench=f"--bench={lab}")) == 0
    firsts = [ran for ran in steps.run if ran != "second"]
    assert firsts == [("first", *(answers or (50.0, 100.0)))]


def test_another_number_corrects_an_answer_after_a_fault(
    steps: Steps, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    only = dataclasses.replace(setup.STEPS[1], asks=(WEIGHT,))
    steps.monkeypatch.setattr(setup, "STEPS", (only,))
    steps.state = "FAULT"
    asked = steps.answers("50", "-60", "60", "banana", "", "", "accept")
    assert setup.run(parsed(tmp_path)) == 0
    text = capsys.readouterr().out
    assert "weight_g: found '-60'; allowed: 1 to" in text
    assert "found 'banana'; allowed: Enter to measure again" in text
    assert asked[5] == "mass of the known weight [g] [60]:"
    assert steps.run == ["second"] * 3


def test_a_lost_device_and_wrong_input_are_named(
    steps: Steps, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text(f"extends: {BENCH}\n{LAB}")
    steps.lost = True
    assert setup.run(parsed(tmp_path, "--yes", "--answer", "weight_g=20")) == 3
    assert "FAULT  second     the gauge is gone" in capsys.readouterr().out
    assert steps.run[0] == ("first", 20.0, 100.0)
    for words, more in (
        ("--answer: found 'weight=3'; allowed: weight_g=", ["--yes", "--answer", "weight=3"]),
        (
            "weight_g: found 'x'; allowed: 1 to 1472",
            ["--yes", "--again=first", "--answer=weight_g=x"],
        ),
        ("--yes: found with a lab bench", ["--yes"]),
        ("no terminal to ask on", []),
        ("--calibrations: /proc/x: No such file or dir", ["--calibrations", "/proc/x"]),
        (f"--calibrations: {lab}: File exists; allowed: a folder", ["--calibrations", str(lab)]),
    ):
        bench = f"--bench={BENCH}" if "weight" in words else f"--bench={lab}"
        with pytest.raises(ConfigError, match=words):
            setup.run(parsed(tmp_path, *more, bench=bench))
    path = tmp_path / "gelsight.setup.json"
    path.write_text("{")
    with pytest.raises(ConfigError, match="remove the file, and set up again"):
        setup.run(parsed(tmp_path, "--yes"))


def test_steps_of_benches_with_and_without_a_gauge() -> None:
    file = BenchFile.read(BENCH)
    bench, content = file.bench, file.content
    bare = bench_from(without_gauge(content, "bench"), "bench")
    names = [{step.name for step in setup.STEPS if step.needed(each)} for each in (bench, bare)]
    assert names[0] - names[1] == {"gauge", "latency"}
    assert names[1] - names[0] == {"touch"}
    assert all((step.check.__doc__ or "").strip().endswith((".", "?")) for step in setup.STEPS)


@pytest.mark.parametrize(("code", "cure"), [(3, "power, cable"), (4, "contact_frame")])
def test_a_command_that_stopped_is_a_fault_with_a_cure_by_its_exit_code(
    code: int, cure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[tuple[Any, ...]] = []
    monkeypatch.setattr(setup, "apart", lambda *called: ran.append(called) or code)
    at = setup.AtBench(parsed(tmp_path, "--yes", "--indenter", "sphere"), {})
    (found,) = setup.home(at, {})
    assert found.state == "FAULT"
    assert cure in found.cures[0]
    ((command, recording),) = ran
    assert command is find_by_force
    assert (recording.file.path, recording.bench.indenter) == (BENCH, "sphere")


@pytest.mark.slow
@pytest.mark.serial
@pytest.mark.timeout(600)
@pytest.mark.parametrize("more", [["--sensor", "uskin"], ["--sensor", "gelsight", "--force=none"]])
def test_a_mock_bench_is_set_up_to_the_end(
    more: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*words: str) -> int:
        return subprocess.run([sys.executable, "-m", "tactile", *words], check=False).returncode

    monkeypatch.chdir(tmp_path)
    assert run("setup", *more, "--yes") == 0
    assert list(Path("calibrations").glob("*.acceptance.html"))
    assert run("collect", *more, "--targets", "1", "--out", "x.zarr") == 0
    accepted = Session("x.zarr").attrs["calibration"]["acceptance"]
    assert accepted["result"] == "accepted"
    assert set(accepted["steps"].values()) <= {"well", "note"}
