"""The verbs `accuracy` and `cost-table`: what they take, refuse and write."""

import argparse
from pathlib import Path

import pytest
from support.made_up_costs import made_up

from benchmarks.sim.accuracy import command as accuracy
from benchmarks.sim.accuracy.row import read
from benchmarks.sim.cost_table import command as cost_table
from benchmarks.sim.cost_table.seconds import write as write_seconds
from sim.device import ready_device
from sim.errors import SceneError
from sim.planner import error_model as table_file
from sim.planner import seconds as seconds_file
from sim.planner.features import Choice
from sim.planner.seconds import Timed

STORED_FILES = ((table_file, "TRAINING"), (table_file, "HELD_OUT"), (seconds_file, "STORED"))


def run(verb, *words):
    parser = argparse.ArgumentParser()
    verb.add_to(parser.add_subparsers(required=True))
    name = "accuracy" if verb is accuracy else "cost-table"
    options = parser.parse_args([name, *words])
    return options.run(options)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--case", "ball"], "--case: 'ball'; allowed: sphere"),
        (["--reference", "-1"], "--reference: -1.0 mm; allowed: above 0"),
        (["--device", "cuda:99"], "--device: 'cuda:99'; allowed here: cpu"),
        (["--only", "page"], "--out: no measurements in"),
    ],
)
def test_accuracy_refuses_what_means_nothing(tmp_path, words, said):
    with pytest.raises(SceneError, match=said):
        run(accuracy, "--out", str(tmp_path), *words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--table", "--batches", "0"], "--batches: 0; allowed: 1 or more"),
        (["--table", "--meshes", "3,x"], "--meshes: '3,x'; allowed: some of 3, 4"),
        (["--table", "--meshes", "3,5", "--reference", "5"], "--reference: 5; allowed: above 5"),
        (["--table", "--device", "cuda:99"], "--device: 'cuda:99'"),
    ],
)
def test_cost_table_refuses_what_means_nothing(tmp_path, words, said):
    with pytest.raises(SceneError, match=said):
        run(cost_table, "--work", str(tmp_path), *words)


def test_a_page_without_a_table_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(table_file, "TRAINING", Path(tmp_path / "none.csv"))
    with pytest.raises(SceneError, match=r"none.csv: not there"):
        run(cost_table, "--page", "--out", str(tmp_path / "page.md"))


def test_what_was_measured_elsewhere_is_taken_home(tmp_path, monkeypatch):
    own = tmp_path / "own"
    for module, name in STORED_FILES:
        monkeypatch.setattr(module, name, own / f"{name}.csv")
    with pytest.raises(SceneError, match="has nothing to take"):
        run(cost_table, "--take", str(tmp_path))
    table_file.write(tmp_path / "training.csv", made_up(1, 40))
    table_file.write(tmp_path / "held-out.csv", made_up(2, 40))
    for device, took in (("cpu", 2.0), ("cuda", 0.1), ("cuda", 0.2)):
        press = Timed(device, "m", Choice("fem", 4), 100, 10, 100, 3, took)
        write_seconds(tmp_path / f"seconds-{device}.csv", [press])
        run(cost_table, "--take", str(tmp_path), "--out", str(tmp_path / "page.md"))
    assert [(one.device, one.seconds) for one in seconds_file.read()] == [("cpu", 2), ("cuda", 0.2)]
    assert table_file.read(own / "HELD_OUT.csv").rows[0].scene == "made-up-2-0"
    text = (tmp_path / "page.md").read_text()
    assert "% of error bars" not in text
    assert "promised tolerances hold" in text
    assert "| smooth press |" in text
    assert "nan" not in text


@pytest.mark.slow
def test_accuracy_measures_and_draws(tmp_path):
    words = ["--smoke", "--out", str(tmp_path / "accuracy"), "--references", str(tmp_path)]
    assert run(accuracy, *words) == 0
    kept = read(tmp_path / "accuracy" / "cpu.jsonl")
    names = [row.name for row in kept.rows]
    assert names == ["closed form", "layer", "fem float32 1.25 mm", "fem float32 1 mm"]
    assert all(row.memory > 2**26 for row in kept.rows[1:])
    assert (tmp_path / "accuracy.md").read_text().startswith("# What accuracy costs")
    assert (tmp_path / "images" / "accuracy.png").exists()
    before = (tmp_path / "accuracy" / "cpu.jsonl").read_text()
    assert run(accuracy, *words) == 0
    assert (tmp_path / "accuracy" / "cpu.jsonl").read_text() == before


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_small_cost_table_is_measured_timed_checked_and_drawn(tmp_path, monkeypatch):
    ready_device("cpu")
    for module, name in STORED_FILES:
        monkeypatch.setattr(module, name, tmp_path / f"{name.lower()}.csv")
    page = tmp_path / "cost-table.md"
    words = ["--batches", "1", "--meshes", "3,4", "--reference", "5", "--work", str(tmp_path)]
    assert run(cost_table, *words, "--seconds-max", "2", "--out", str(page)) == 0
    text = page.read_text()
    assert "promised tolerances hold" in text
    assert "elements (d newton + e cg)" in text
    assert len(table_file.read(tmp_path / "training.csv").rows) >= 20
