"""The set-up goes on where it stopped, and its acceptance goes with every session."""

import argparse
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


class Steps:
    """Two steps, whose findings a test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.run: list[Any] = []
        self.monkeypatch = monkeypatch
        self.state = "well"
        self.lost = False

        def first(at: setup.AtBench, answers: setup.Answers) -> Iterator[Finding]:
            """Is the first part well?"""
            self.run.append(("first", answers["weight_g"]))
            yield Finding("part", "well", "<b>well</b>")

        def second(at: setup.AtBench, answers: setup.Answers) -> Iterator[Finding]:
            """Is the second part well?"""
            self.run.append("second")
            at.record.keep_picture("camera.jpeg", b"a picture")
            if self.lost:
                raise DeviceLost("the gauge is gone")
            yield Finding("part", self.state, "found", ("a cure",))  # type: ignore[arg-type]

        weight = setup.Question("weight_g", "mass [g]", lambda bench: 100.0)
        steps = (setup.Step(first, ("force",), (weight,)), setup.Step(second, ("camera",)))
        monkeypatch.setattr(setup, "STEPS", steps)

    def answers(self, *typed: str) -> list[str]:
        """Find a fault in the second step, and type these answers; return what is asked."""
        self.state = "FAULT"
        left, asked = list(typed), list[str]()

        def answer(prompt: str) -> str:
            asked.append(prompt.strip())
            return left.pop(0)

        self.monkeypatch.setattr(setup, "answer", answer)
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
    assert steps.run == [("first", 100.0)]


def test_a_step_is_repeated_once_its_part_of_the_bench_file_changes(
    steps: Steps, tmp_path: Path
) -> None:
    file = tmp_path / "bench.yaml"
    for rate, run in ((1000, 2), (500, 1), (500, 0)):
        file.write_text(f"extends: {BENCH}\nforce: {{rate_hz: {rate}}}\n")
        steps.run = []
        assert setup.run(parsed(tmp_path, "--yes", bench=f"--bench={file}")) == 0
        assert len(steps.run) == run


def test_the_person_may_measure_again_or_accept_a_fault(steps: Steps, tmp_path: Path) -> None:
    asked = steps.answers("heavy", "50", "", "accept")
    assert setup.run(parsed(tmp_path)) == 0
    assert steps.run == [("first", 50.0), "second", "second"]
    assert asked[:2] == ["mass [g] [100]:"] * 2
    accepted = store.acceptance_of(tmp_path, BenchFile.read(BENCH).bench)
    assert accepted is not None
    assert accepted["result"] == "accepted with faults: second"


@pytest.mark.parametrize("typed", ["a", " accept it", "accept\naccept"])
def test_only_the_word_accepts_a_fault(steps: Steps, tmp_path: Path, typed: str) -> None:
    steps.answers("50", typed)
    assert setup.run(parsed(tmp_path)) == 3
    assert store.acceptance_of(tmp_path, BenchFile.read(BENCH).bench) is None


def test_a_lost_device_and_wrong_input_are_named(
    steps: Steps, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = tmp_path / "lab.yaml"
    lab.write_text(f"extends: {BENCH}\nmock: false\nworld: null\nsimulated: null\n")
    steps.lost = True
    assert setup.run(parsed(tmp_path, "--yes", "--answer", "weight_g=20")) == 3
    assert "FAULT  second     the gauge is gone" in capsys.readouterr().out
    assert steps.run[0] == ("first", 20.0)
    for words, more in (
        ("--answer: found 'weight=3'; allowed: weight_g=", ["--yes", "--answer", "weight=3"]),
        (
            "weight_g: found 'x'; allowed: a number",
            ["--yes", "--again=first", "--answer=weight_g=x"],
        ),
        ("--yes: found with a lab bench", ["--yes"]),
        ("no terminal to ask on", []),
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
