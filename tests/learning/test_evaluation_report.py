"""The report of synthetic predictions, and scores of translations of known quality."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import run_module
from support.made_up_archives import archive_of
from support.predicted_forces import predictions

from learning.cli import evaluate
from learning.data.splits import Split, make_split
from learning.errors import LearningError
from learning.evaluation.distribution import MARKER_GRID
from learning.evaluation.report import write_report
from learning.evaluation.translation import (
    FLOOR,
    NEAREST,
    REFERENCE,
    SOURCE,
    TRANSLATED,
    TranslationScores,
    half_of_locations,
    paired_rows,
    read_scores,
    require_alone,
    score_translation,
)
from learning.translation.archive import NamedTranslator, Pair, translate_archive
from recorder import MarkerArchive


class Still:
    """A translator that always returns the target's reference."""

    name = "still"

    def translate(self, source: Any, target_reference: Any, *_: Any, **__: Any) -> Any:
        return target_reference.expand_as(source)


archive = archive_of(indenters=("cone", "prism"), targets=12, frames_per_phase=1)


@pytest.fixture(scope="module")
def split(archive: MarkerArchive) -> Split:
    return make_split(archive, validation=0.1, new_press=0.1, seed=0)


@pytest.fixture(scope="module")
def translated(archive: MarkerArchive, tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    out = tmp_path_factory.mktemp("translated") / "still.markers.zarr"
    translate_archive(
        archive, out, [Pair("dots", "grid")], NamedTranslator(Still(), "still", "0" * 64)
    )
    return MarkerArchive(out)


@pytest.fixture(scope="module")
def scores(archive: MarkerArchive, split: Split, translated: MarkerArchive) -> TranslationScores:
    return score_translation(
        archive, translated["dots-to-grid"], split, ["new_indenter"], MARKER_GRID, frames=40
    )


@pytest.mark.slow
def test_a_translator_that_shows_the_reference_scores_as_the_reference(
    scores: TranslationScores,
) -> None:
    paired = {row.method: row for row in scores.paired}
    assert paired[TRANSLATED].dice == paired[REFERENCE].dice
    assert paired[TRANSLATED].epe_px == paired[REFERENCE].epe_px
    distances = {row.method: row for row in scores.distances}
    assert distances[TRANSLATED].frechet == distances[REFERENCE].frechet


def test_real_frames_beside_themselves_are_perfect(scores: TranslationScores) -> None:
    (floor,) = [row for row in scores.paired if row.method == FLOOR]
    assert (floor.dice, floor.iou, floor.ssim, floor.count_mismatch) == (1, 1, 1, 0)
    assert floor.centroid_px == 0
    # For bent markers the moved centre differs slightly from the centre of the moved marker.
    others = [row.epe_px for row in scores.paired if row.method in (REFERENCE, NEAREST)]
    assert floor.epe_px < 0.5 < min(others)


def test_the_source_as_it_is_is_told_from_the_target_and_the_floor_is_not(
    scores: TranslationScores,
) -> None:
    distances = {row.method: row for row in scores.distances}
    assert distances[SOURCE].mixing < 0.1
    assert distances[FLOOR].frechet < 0.2 * distances[SOURCE].frechet
    assert distances[FLOOR].mixing > 0.5


def test_pixels_become_millimetres_by_the_target(scores: TranslationScores) -> None:
    (row,) = [row for row in scores.paired if row.method == REFERENCE]
    assert row.centroid_mm == pytest.approx(0.03 * row.centroid_px)
    assert row.epe_mm == pytest.approx(0.03 * row.epe_px)


def test_halves_share_no_location() -> None:
    location = np.repeat(np.arange(11), 4)
    half = half_of_locations(location, seed=1)
    assert not set(location[half]) & set(location[~half])
    assert len(set(location[half])) == 5


def test_scores_come_back_as_they_were_written(tmp_path: Path, scores: TranslationScores) -> None:
    scores.write(tmp_path / "x.npz")
    back = read_scores(tmp_path / "x.npz")
    assert repr(back.paired) == repr(scores.paired)  # NaN is not equal to itself
    assert back.distances == scores.distances
    assert back.features.keys() == {SOURCE, TRANSLATED, FLOOR}


def test_other_features_add_distances_and_no_paired_rows(scores: TranslationScores) -> None:
    others = [replace(row, extractor="marker-ae@sha256:0") for row in scores.distances]
    again = replace(scores, distances=tuple(others))
    require_alone([scores, again])
    assert [row for _, row in paired_rows([scores, again])] == list(scores.paired)
    with pytest.raises(LearningError, match="twice"):
        require_alone([scores, again, scores])


def test_an_untranslated_archive_is_refused(archive: MarkerArchive, split: Split) -> None:
    with pytest.raises(LearningError, match="allowed: frames translated from and to"):
        score_translation(archive, archive["grid"], split, ["new_indenter"], MARKER_GRID)


@pytest.mark.slow
def test_a_report_tells_before_and_after_in_one_page_and_in_tables(
    tmp_path: Path, scores: TranslationScores
) -> None:
    made = [
        predictions("source-only", ("array-i", "circle-i"), off=1.5),
        predictions("transferred", ("array-i", "circle-i"), off=0.25, translator="flow"),
        predictions("target", ("circle-i", "circle-i"), off=0.125),
    ]
    report = write_report(made, [scores], tmp_path / "report")
    page = report.files[0].read_text()
    assert "array-i to circle-i" in page
    assert "frechet, kernel [marker-grid-8x8]" in page
    assert "FID, KID [" not in page
    assert page.count("data:image/png;base64,") >= 6
    assert "http" not in page  # no external resources
    assert "<th>SSIM</th>" in page
    with (tmp_path / "report/translation.csv").open() as file:
        ssim = {line["method"]: float(line["ssim"]) for line in csv.DictReader(file)}
    assert ssim[SOURCE] < ssim[TRANSLATED] < ssim[FLOOR] == 1
    with (tmp_path / "report/force.csv").open() as file:
        lines = list(csv.DictReader(file))
    wanted = ["array-i", "transferred", "new_indenter"]
    (line,) = [one for one in lines if [one["source"], one["method"], one["role"]] == wanted]
    assert float(line["mae_fz_n"]) == pytest.approx(0.25)
    files = {"report.html", "force.csv", "translation.csv", "distances.csv"}
    assert {path.name for path in (tmp_path / "report").iterdir()} == files
    assert report.lines[-1].startswith("new_indenter: source-only R2 -")


@pytest.mark.slow
def test_evaluate_scores_translations_keeps_them_and_reports(
    tmp_path: Path,
    archive: MarkerArchive,
    translated: MarkerArchive,
    split: Split,
    capsys: pytest.CaptureFixture[str],
) -> None:
    predictions("source-only", off=1.0).write(tmp_path / "results/a/one.npz")
    split.write(tmp_path / "split.json")
    places = [str(translated.path), str(archive.path), "--split", str(tmp_path / "split.json")]
    folder, out = str(tmp_path / "results"), str(tmp_path / "report")
    assert run_module(evaluate, folder, *places, "--out", out) == 0
    assert (tmp_path / "results/dots-to-grid.still.marker-grid-8x8.npz").exists()
    assert (tmp_path / "report/distances.csv").exists()
    assert "report.html: written" in capsys.readouterr().out


def test_evaluate_says_what_is_missing(
    tmp_path: Path, archive: MarkerArchive, translated: MarkerArchive
) -> None:
    predictions().write(tmp_path / "results/one.npz")
    cut = (tmp_path / "results/one.npz").read_bytes()[:100]
    (tmp_path / "results/two.npz").write_bytes(cut)
    for place, message in (
        (translated.path, "found none of real frames"),
        (archive.path, "found archives alone; allowed: results"),
        (tmp_path / "nowhere", "nowhere: found no folder; allowed: results"),
        (tmp_path / "results", r"two\.npz"),
    ):
        with pytest.raises(LearningError, match=message):
            run_module(evaluate, place, "--out", tmp_path / "report")
    with pytest.raises(LearningError, match="neither predictions nor translation scores"):
        write_report([], [], tmp_path / "report")
    assert not (tmp_path / "report").exists()
