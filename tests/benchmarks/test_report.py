"""Options, pages and measurements that all benchmarks share."""

import argparse
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure

from benchmarks import report
from benchmarks.__main__ import main
from benchmarks.processes import rows_of
from benchmarks.report import FAILED, RESULTS, Benchmark, Page, Part, Run, table
from recorder.command_line.errors import CommandError

SPEEDS = {"ours": 3.0, "theirs": 2.0}


def measure_speed(run: Run) -> dict[str, float]:
    run.seeds, run.spread = range(5), "median of 5 runs, range at most 4 %"
    run.progress(0.5)
    (run.folder / "scratch").touch()
    return SPEEDS


def show_speed(values: dict[str, float], page: Page) -> str:
    page.picture("speed").write_bytes(b"a picture")
    return (
        f"## Speed\n{table(['store', 'MB/s'], [*values.items()])}\n\n{page.link('speed', 'bars')}"
    )


def benchmark(measure_size: Callable[[Run], Any] = lambda run: [1, 2]) -> Benchmark:
    return Benchmark(
        "stores",
        "Stores compared",
        "Which store is fastest?",
        (
            Part("speed", measure_speed, show_speed, weight=3.0),
            Part("size", measure_size, lambda values, page: f"## Size\nThe largest: {values[-1]}."),
        ),
        summary=lambda values: f"Measured: {', '.join(values)}.",
    )


def run(of: Benchmark, *words: str) -> int:
    parser = argparse.ArgumentParser()
    of.add_arguments(parser)
    return of.run(parser.parse_args(words))


def interrupt(run: Run) -> None:
    raise KeyboardInterrupt


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Path of the page of complete runs; that of quick ones is in `quick` beside it."""
    monkeypatch.setattr(report, "RESULTS", tmp_path)
    monkeypatch.setattr(report, "QUICK_RESULTS", tmp_path / "quick")
    return tmp_path / "stores.md"


def test_a_page_states_how_it_was_made_and_shows_each_part(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(benchmark()) == 0
    assert capsys.readouterr().out == f"written: {page}, stores.json\n"
    text = page.read_text()
    assert text.startswith("# Stores compared\n\nWhich store is fastest?\n\nMade by `python -m")
    assert f"commit {report.commit()}; [measurements](stores.json)." in text
    assert "\n| speed | 0 to 4 | median of 5 runs, range at most 4 % | 0 s |\n" in text
    assert "\n| size | none | single run | 0 s |\n" in text
    assert "\nMeasured: speed, size.\n" in text
    assert "| store | MB/s |\n|---|---:|\n| ours | 3.0 |\n| theirs | 2.0 |\n" in text
    assert "![bars](images/stores-speed.png)" in text
    assert text.endswith("\n## Size\nThe largest: 2.\n")
    assert (page.parent / "images" / "stores-speed.png").read_bytes() == b"a picture"


def test_measurements_are_stored_with_command_machine_commit_and_seeds(page: Path) -> None:
    run(benchmark())
    stored = json.loads(page.with_suffix(".json").read_text())
    assert [*stored] == ["speed", "size"]
    speed = stored["speed"]
    assert speed["results"] == SPEEDS
    assert (speed["seeds"], speed["failures"], speed["quick"]) == ([0, 1, 2, 3, 4], [], False)
    assert speed["commit"] == report.commit()
    assert speed["machine"] == report.machine_name()


def test_a_part_measured_alone_leaves_the_others_as_they_are(page: Path) -> None:
    run(benchmark())
    before = json.loads(page.with_suffix(".json").read_text())
    assert run(benchmark(lambda run: [7]), "--only", "size") == 0
    after = json.loads(page.with_suffix(".json").read_text())
    assert after["speed"] == before["speed"]
    assert after["size"]["results"] == [7]
    assert "| ours | 3.0 |" in page.read_text()
    assert "The largest: 7." in page.read_text()


def test_parts_measured_on_different_machines_are_each_named_with_theirs(
    page: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(benchmark())
    monkeypatch.setattr(report, "machine_name", lambda device: "Analytical Engine, 1 cores")
    run(benchmark(), "--only", "size")
    text = page.read_text()
    assert "Parts were measured one by one; " in text
    assert "| part | seeds | spread | took | made by | machine | commit |" in text
    (row,) = (line for line in text.splitlines() if line.startswith("| size |"))
    assert "Analytical Engine" in row


def test_a_page_is_drawn_again_from_its_measurements_alone(page: Path) -> None:
    run(benchmark())
    text = page.read_text()
    page.write_text("edited")
    assert run(benchmark(interrupt), "--draw") == 0
    assert page.read_text() == text


def test_a_quick_run_says_so_and_leaves_the_page_of_the_complete_one(page: Path) -> None:
    run(benchmark())
    text = page.read_text()
    run(benchmark(lambda run: [9 if run.quick else 2]), "--quick")
    assert page.read_text() == text
    quick = (page.parent / "quick" / "stores.md").read_text()
    assert "**Quick runs, whose numbers mean little: speed, size.** Made by" in quick
    assert "The largest: 9." in quick


def test_what_must_hold_and_does_not_gives_exit_code_1_and_is_on_the_page(
    page: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(run: Run) -> list[int]:
        run.failures.append("99 MB lost")
        return [99]

    assert run(benchmark(fail)) == FAILED
    assert capsys.readouterr().out.endswith("\nFAILED: size: 99 MB lost\n")
    assert "\n**Failed:** size: 99 MB lost\n" in page.read_text()


def test_ctrl_c_keeps_the_parts_that_were_measured(page: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(benchmark(interrupt))
    assert run(benchmark(), "--draw") == 0
    text = page.read_text()
    assert "| ours | 3.0 |" in text
    assert "## Size" not in text
    assert "**Not measured:** size.\n" in text


def test_what_another_run_measures_meanwhile_stays(page: Path) -> None:
    def measure(ours: Run) -> list[int]:
        assert run(benchmark(), "--only", "speed") == 0
        return [int(ours.once("row", lambda: 7))]

    assert run(benchmark(measure), "--only", "size") == 0
    assert [*json.loads(page.with_suffix(".json").read_text())] == ["speed", "size"]


@pytest.mark.parametrize(("after", "measured"), [("1a2b", [2, 3]), ("1a2b+", [1, 2, 3])])
def test_an_interrupted_part_goes_on_at_its_next_row_unless_code_has_changed(
    after: str, measured: list[int], page: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows: list[int] = []

    def row(number: int) -> int:
        rows.append(number)
        return 10 * number

    def measure(run: Run, last: int = 3) -> list[int]:
        run.options.processes = 1
        every = rows_of(run, row, {f"row {number}": number for number in (1, 2, 3)[:last]})
        if last < 3:
            raise KeyboardInterrupt
        return [*every.values()]

    monkeypatch.setattr(report, "commit", lambda: "1a2b")
    with pytest.raises(KeyboardInterrupt):
        run(benchmark(lambda run: measure(run, 1)))
    monkeypatch.setattr(report, "commit", lambda: after)
    rows.clear()
    assert run(benchmark(measure), "--only", "size") == 0
    assert rows == measured
    text = page.with_suffix(".json").read_text()
    assert [*json.loads(text)] == ["speed", "size"]
    assert '  "results": [10,20,30]\n' in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, r"--draw: .*stores\.json: no measured part"),
        ('{"speed"', r"stores\.json: not JSON: "),
        ("[]", r"stores\.json: not the measurements of a benchmark"),
        ('{"speed": {}}', r"stores\.json: does not fit this version .*: KeyError: 'results'"),
        ('{"speed": 3}', r"stores\.json: does not fit this version .*: TypeError"),
    ],
)
def test_values_that_do_not_fit_are_refused(text: str | None, message: str, page: Path) -> None:
    if text is not None:
        page.with_suffix(".json").write_text(text)
    with pytest.raises(CommandError, match=message):
        run(benchmark(), "--draw")
    assert not page.exists()


def test_values_of_another_version_are_refused_by_name(page: Path) -> None:
    run(benchmark(lambda run: []), "--only", "speed")
    path = page.with_suffix(".json")
    stored = json.loads(path.read_text())
    path.write_text(json.dumps(stored | {"size": stored["speed"] | {"results": []}}))
    with pytest.raises(CommandError, match=r"does not fit this version .*: IndexError"):
        run(benchmark(), "--draw")


@pytest.mark.parametrize("name", sorted(path.stem for path in RESULTS.glob("*.json")))
def test_each_page_is_what_its_command_draws_from_its_measurements(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Its charts are composed, but not rendered, which takes most of the time.
    monkeypatch.setattr(Figure, "savefig", lambda *_file, **_options: None)
    page = tmp_path / f"{name}.md"
    shutil.copy(RESULTS / f"{name}.json", tmp_path)
    assert main([name, "--draw", "--out", str(page)]) == 0
    assert page.read_text(encoding="utf-8") == (RESULTS / page.name).read_text(encoding="utf-8")
