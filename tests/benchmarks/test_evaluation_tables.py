"""The paper's tables, from synthetic experiments."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from support.predicted_forces import predictions

from benchmarks.__main__ import main
from benchmarks.learning.tables.group_results import read_group
from benchmarks.learning.tables.page import write_tables
from benchmarks.learning.tables.paper_figures import PAPER, beside_the_paper, group_of
from learning.compensation.fit import StoredCompensation, StoredPair
from learning.compensation.prior import Branch, Prior
from learning.compensation.search import Choice
from learning.evaluation.predictions import force_rows
from learning.evaluation.translation import PairedScore, TranslationScores

PAIRS = (("array-i", "circle-i"), ("circle-i", "array-i"))


def score(method: str, dice: float, role: str = "new_indenter") -> PairedScore:
    ssim, nan = 0.8, np.nan
    return PairedScore(role, method, 48, dice, 0.9, ssim, 0.25, 1.0, 0.02, 0.125, 0.1, nan, nan)


@pytest.fixture
def experiment(tmp_path: Path) -> Path:
    """Two sensors: `direct` is worse than `flow`, and one pair of `flow` worse than the other."""
    folder = tmp_path / "homogeneous"
    made = [predictions("target", (name, name), off=0.125) for name in ("array-i", "circle-i")]
    for pair, off in zip(PAIRS, (0.25, 0.5), strict=True):
        made += [
            predictions("source-only", pair, off=1.5),
            predictions("transferred", pair, off=off, translator="flow"),
            predictions("transferred", pair, off=1.0, translator="direct"),
        ]
    for number, one in enumerate(made):
        one.write(folder / "results" / f"{number}.npz")
    for pair, dice in zip(PAIRS, (0.98, 0.92), strict=True):
        paired = (
            score("translated", dice),
            score("translated", 0.5, "new_press"),
            score("reference as is", 0.85),
        )
        scores = TranslationScores(*pair, "flow", "abc", paired, (), {})
        scores.write(folder / "results" / f"{pair[0]}.scores.npz")
    return folder


def test_the_page_tells_goals_means_pairs_and_the_paper(
    experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    intro = tmp_path / "intro.txt"
    intro.write_text("Made by hand.\n")
    page = tmp_path / "docs" / "tables.md"
    assert (
        main(["learning-tables", str(experiment), "--out", str(page), "--intro", str(intro)]) == 0
    )
    lines = page.read_text().splitlines()
    assert lines[0].startswith("# Forces on sensors")
    assert "Made by hand." in lines
    assert "nan" not in page.read_text()
    # Labels have ranges of 4 N and 2 N; 0.375 N is the mean error of both pairs.
    goal = "| MAE of Fz over the labels' range [%] | below 2.8 % (the paper's worst: 5.6) |"
    assert f"{goal} 9.4 | 12.5 (circle-i to array-i) |" in lines
    assert "| Dice | above 0.97 | 0.950 | 0.920 (circle-i to array-i) |" in lines
    assert any(line.startswith("| transferred, flow | 2 | 0.375, 0.375, 0.375 |") for line in lines)
    assert any(line.startswith("| target | 2 | 0.125, 0.125, 0.125 |") for line in lines)
    assert "| by flow | 0.950 | 0.25 | 0.020 | - | 12 |" in lines
    assert "| reference as is | 0.850 | 0.25 | 0.020 | - | 12 |" in lines
    pair = next(line for line in lines if line.startswith("| array-i to circle-i | "))
    assert pair.endswith("| 0.980 |")
    assert "0.250, 0.250" in pair
    beside = "| transferred, flow: fz, min (ours of 2 pairs, not 20) | < 0.7 N | 0.25 N |"
    assert any(line.startswith(beside) for line in lines)
    assert "## At a glance" not in lines, "one experiment says it all itself"
    folder = page.with_suffix("")
    assert (folder / "homogeneous.png").read_bytes().startswith(b"\x89PNG")
    with (folder / "force.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["group"] for row in rows} == {"homogeneous"}
    assert {row["role"] for row in rows} == {"new_indenter"}
    assert {path.name for path in folder.iterdir()} == {
        "homogeneous.png",
        "force.csv",
        "translation.csv",
        "paper.csv",
    }
    assert str(page) in capsys.readouterr().out


def test_an_experiment_may_be_called_otherwise_and_have_come_to_no_end(
    experiment: Path, tmp_path: Path
) -> None:
    for path in (experiment / "results").glob("*.scores.npz"):
        path.unlink()
    page = tmp_path / "tables.md"
    assert main(["learning-tables", f"mine={experiment}", "--out", str(page)]) == 0
    text = page.read_text()
    assert "## Mine" in text
    assert text.startswith("# Forces on sensors that never saw a force gauge")
    assert "| goal (transferred, flow) |" in text
    assert "Translated images" not in text
    assert not (tmp_path / "tables" / "translation.csv").exists()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{experiment}", "--out", "{tmp}/page.html"], "--out: found .*; allowed: a name that"),
        (["{tmp}/nothing", "--out", "{tmp}/page.md"], "nothing: found no results; allowed"),
        (["{experiment}", "{experiment}", "--out", "{tmp}/page.md"], "allowed: different names"),
        (
            ["{experiment}", "--out", "{tmp}/page.md", "--intro", "{tmp}/none"],
            "--intro: found no .*none; allowed: a file",
        ),
    ],
)
def test_what_makes_no_table_is_an_error_and_writes_nothing(
    experiment: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    filled = [word.format(experiment=experiment, tmp=tmp_path) for word in words]
    assert main(["learning-tables", *filled]) == 2

    assert re.search(message, capsys.readouterr().err)
    assert not (tmp_path / "page.md").exists()


def test_forces_that_were_not_transferred_are_no_table(experiment: Path, tmp_path: Path) -> None:
    for path in (experiment / "results").glob("*.npz"):
        path.unlink()
    one = predictions("source-only", PAIRS[0], off=1.5)
    one.write(experiment / "results" / "0.npz")
    assert main(["learning-tables", str(experiment), "--out", str(tmp_path / "page.md")]) == 2


def test_what_needs_no_label_of_the_target_is_told_of_and_how_far_its_labels_were(
    experiment: Path, tmp_path: Path
) -> None:
    for number, pair in enumerate(PAIRS):
        for method, off in (("compensated", 0.5), ("priors", 0.25), ("oracle", 0.125)):
            one = predictions(method, pair, off=off, translator="flow")
            one.write(experiment / "results" / f"{method}{number}.npz")
    branch = Branch((1.0, 0.0), 0.1, 3)
    priors = {name: Prior(name, branch, branch, 1e-3, 1e-3) for name in PAIRS[0]}
    before, half = Choice(0.0, 0.0, 2.0, r2=0.25), Choice(0.0, 0.5, 1.0, r2=0.5)
    stored = [
        StoredPair(*PAIRS[0], before, {"default": half, "oracle": Choice(0.0, 1.0, 0.0, r2=1.0)}),
        StoredPair(*PAIRS[1], before, {"default": Choice(0.0, 0.5, 1.5)}),
    ]
    StoredCompensation(priors, tuple(stored)).write(experiment / "compensation.json")
    page = tmp_path / "tables.md"
    write_tables([read_group("homogeneous", experiment)], page)
    lines = page.read_text().splitlines()
    assert any(line.startswith("| goal (priors, flow) |") for line in lines)
    assert any(line.startswith("| oracle, flow | 2 | 0.125,") for line in lines)
    before_line = "| as they are | 0.250 | 0.250 (array-i to circle-i) | 2.000 |"
    assert any(line.startswith(before_line) for line in lines)
    worst = "0.500 (array-i to circle-i) | 1.250 | 1.500 (circle-i to array-i)"
    assert f"| compensated | 0.500 | {worst} |" in lines


def test_several_are_told_of_at_a_glance_below_the_intro(experiment: Path, tmp_path: Path) -> None:
    for number, pair in enumerate(PAIRS):
        one = predictions("priors", pair, off=0.25, translator="flow")
        one.write(experiment / "results" / f"priors{number}.npz")
    branch = Branch((1.0, 0.0), 0.1, 3)
    priors = {name: Prior(name, branch, branch, 1e-3, 1e-3) for name in PAIRS[0]}
    choices = [Choice(0.0, 0.0, 2.0, r2=0.25), Choice(0.0, 1.0, 1.0, r2=0.5)]
    stored = [
        StoredPair(*pair, Choice(0.0, 0.0, 3.0, r2=0.0), {"priors": choice})
        for pair, choice in zip(PAIRS, choices, strict=True)
    ]
    StoredCompensation(priors, tuple(stored)).write(experiment / "compensation.json")
    page = tmp_path / "tables.md"
    groups = [read_group(name, experiment) for name in ("homogeneous", "again")]
    write_tables(groups, page, "# What limits it\n\nOne thing at a time.\n")
    lines = page.read_text().splitlines()
    assert lines[:3] == ["# What limits it", "", "One thing at a time."]
    found = [line.split(" | ") for line in lines[: lines.index("## Homogeneous")]]
    told = {cells[0].removeprefix("| "): cells[1:] for cells in found if len(cells) > 2}
    assert told["homogeneous"] == told["again"]
    pairs, model, _before, after, worst, others, _own, labels, errors, fractions, dice = told[
        "again"
    ]
    assert (pairs, model, labels, errors) == ("2", "priors, flow", "0.375", "0.250, 0.250")
    assert float(after) == pytest.approx(float(worst), abs=1e-3)
    assert others == "-", "there is but one indenter"
    assert fractions == "16.7, 6.2"  # the labels' ranges are 3, 1 and 4 N
    assert dice == "0.950 |"


def test_the_papers_figures_stand_beside_ours_of_the_same_pairs_alone() -> None:
    made = [
        predictions("transferred", ("circle-ii", "diamond-i"), off=0.5, translator="flow"),
        predictions("transferred", ("array-i", "circle-i"), off=0.25, translator="flow"),
        predictions("transferred", ("mine", "yours"), off=9, translator="flow"),
    ]
    beside = beside_the_paper(force_rows(made))
    assert {one.figure.group for one in beside} == {"homogeneous"}
    (pair,) = [one for one in beside if one.figure.statistic == "pair"]
    assert (pair.figure.value, pair.held_out, pair.pairs, pair.of) == (0.96, 0.5, 1, 1)
    (largest,) = [
        one for one in beside if (one.figure.statistic, one.figure.measure) == ("max", "fz")
    ]
    assert (largest.held_out, largest.pairs, largest.of) == (0.5, 2, 20)
    assert largest.our_share == pytest.approx(0.5 / 4)


def test_every_figure_of_the_paper_names_pairs_of_its_test() -> None:
    for figure in PAPER:
        if figure.pair:
            assert group_of(*figure.pair) == figure.group
        assert (figure.statistic == "pair") <= (figure.pair is not None)
