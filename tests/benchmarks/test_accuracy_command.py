"""The command `accuracy`: its arguments, its errors and its output files."""

import pytest
from support.commands import run_module

from benchmarks.sim.accuracy import command as accuracy
from benchmarks.sim.accuracy.row import read
from sim.errors import SceneError


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--case", "ball"], "--case: 'ball'; allowed: sphere"),
        (["--reference", "-1"], "--reference: -1.0; allowed: above 0"),
        (["--device", "cuda:99"], "--device: 'cuda:99'; allowed here: cpu"),
        (["--only", "page"], "--out: no measurements in"),
    ],
)
def test_accuracy_refuses_what_means_nothing(tmp_path, words, message):
    with pytest.raises(SceneError, match=message):
        run_module(accuracy, "--out", str(tmp_path), *words)


@pytest.mark.slow
def test_accuracy_measures_and_draws(tmp_path):
    words = ["--smoke", "--out", str(tmp_path / "accuracy"), "--references", str(tmp_path)]
    assert run_module(accuracy, *words) == 0
    kept = read(tmp_path / "accuracy" / "cpu.jsonl")
    names = [row.name for row in kept.rows]
    assert names == ["closed form", "layer", "fem fineness 0.5", "fem even 1.25 mm"]
    assert all(row.memory > 2**26 for row in kept.rows[1:])
    assert (tmp_path / "accuracy.md").read_text().startswith("# Cost of accuracy")
    assert (tmp_path / "images" / "accuracy.png").exists()
    before = (tmp_path / "accuracy" / "cpu.jsonl").read_text()
    assert run_module(accuracy, *words) == 0
    assert (tmp_path / "accuracy" / "cpu.jsonl").read_text() == before
