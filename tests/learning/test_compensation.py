"""Labels are transferred to another skin by equations 7 to 9; priors equal the measurements."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.learning_sessions import record
from support.made_up_archives import archive_of, made_up_archive, write_twin

from learning.compensation.fit import read_stored
from learning.compensation.prior import (
    Branch,
    ForceDepthCurve,
    Prior,
    compensate,
    curve_of_session,
    fit_prior,
    prior_of_coefficients,
)
from learning.compensation.search import (
    PairedLabels,
    best_for_labels,
    best_for_priors,
    paired_labels,
    scored_choice,
)
from learning.compensation.simulated import simulated_labels, simulated_r2
from learning.data.genforce.format import Compensation
from learning.errors import LearningError
from recorder import PHASES, MarkerArchive
from recorder.archive import check_archive
from tactile.__main__ import main

DOWN, SHEARED, BACK, UP = range(len(PHASES))
DEPTH = np.linspace(0.1e-3, 1.2e-3, 12)
# Spring constants per depth, quadratic [N/m^2] and linear [N/m].
HARD, SOFT = (0.8e6, 4.0e3), (0.3e6, 1.5e3)


def spring(name: str, down: tuple[float, float], up: tuple[float, float] | None = None) -> Prior:
    """Return the prior of a spring, fitted to simulated measurements of it."""
    loading, unloading = (
        np.stack([DEPTH, a * DEPTH**2 + b * DEPTH], axis=1) for a, b in (down, up or down)
    )
    return fit_prior(ForceDepthCurve(name, "prism", "made up", loading, unloading))


SOFT_SKIN, HARD_SKIN = spring("soft", SOFT), spring("hard", HARD)


def test_labels_of_one_spring_become_those_of_another() -> None:
    direction = np.random.default_rng(0).normal(size=(12, 6))
    source = direction * (SOFT[0] * DEPTH**2 + SOFT[1] * DEPTH)[:, None]
    target = direction * (HARD[0] * DEPTH**2 + HARD[1] * DEPTH)[:, None]
    phase = np.full(12, DOWN)
    found, clamped = compensate(source, DEPTH, phase, SOFT_SKIN, HARD_SKIN, 0.0, 1.0)
    assert np.allclose(found, target, rtol=1e-9)
    assert clamped == 0
    back, _ = compensate(target, DEPTH, phase, HARD_SKIN, SOFT_SKIN, 0.0, 1.0)
    assert np.allclose(back, source, rtol=1e-9)


def test_lambda_weighs_the_change_and_d0_says_where_it_begins() -> None:
    force, phase = np.ones((12, 3)), np.full(12, SHEARED)
    whole, _ = compensate(force, DEPTH, phase, SOFT_SKIN, HARD_SKIN, 0.0, 1.0)
    half, _ = compensate(force, DEPTH, phase, SOFT_SKIN, HARD_SKIN, 0.5, 0.5)
    deep = DEPTH > 0.6e-3
    assert np.allclose(half[deep], 0.5 + 0.5 * whole[deep])
    assert np.array_equal(half[~deep], force[~deep])
    same, clamped = compensate(force, DEPTH, phase, SOFT_SKIN, HARD_SKIN, 0.0, 0.0)
    assert np.array_equal(same, force)
    assert clamped == 0


def test_loading_and_unloading_have_ratios_of_their_own() -> None:
    elastic = spring("elastic", SOFT)
    lossy = spring("lossy", SOFT, (0.5 * SOFT[0], 0.5 * SOFT[1]))
    force, depth = np.ones((4, 3)), np.full(4, 1.0e-3)
    phase = np.array([DOWN, SHEARED, BACK, UP])
    found, _ = compensate(force, depth, phase, elastic, lossy, 0.0, 1.0)
    assert np.allclose(found[:, 0], [1.0, 1.0, 0.5, 0.5])


def test_sensors_of_unlike_depth_are_compared_at_the_same_share_of_their_ranges() -> None:
    shallow, deep = (
        fit_prior(ForceDepthCurve(name, "prism", "made up", curve, curve), depth_range=reach)
        for name, reach, factor in (("gelsight", 1.0e-3, 2.0), ("tacpalm", 4.5e-3, 1.0))
        for fraction in (np.linspace(0.05, 1.0, 20),)
        for curve in (np.stack([fraction * reach, factor * (fraction + fraction**2)], axis=1),)
    )
    depth, phase = np.array([0.25e-3, 0.5e-3, 1.0e-3]), np.full(3, DOWN)
    found, _ = compensate(np.full((3, 3), 2.0), depth, phase, shallow, deep, 0.0, 1.0)
    assert np.allclose(found, 1.0)


def test_a_ratio_without_a_source_force_is_limited_and_counted() -> None:
    nothing = Branch((0.0, 0.0, 0.0))
    flat = Prior("flat", nothing, nothing, 1.2e-3, 1.2e-3)
    force, phase = np.ones((12, 3)), np.full(12, DOWN)
    most, clamped = compensate(force, DEPTH, phase, flat, HARD_SKIN, 0.0, 1.0)
    assert np.allclose(most, 10.0)
    assert clamped == 12
    least, clamped = compensate(force, DEPTH, phase, HARD_SKIN, flat, 0.5, 1.0)
    assert np.allclose(least[DEPTH > 0.6e-3], 0.1)
    assert clamped == np.count_nonzero(DEPTH > 0.6e-3)
    neither, clamped = compensate(force, DEPTH, phase, flat, flat, 0.0, 1.0)
    assert np.allclose(neither, 1.0)
    assert clamped == 12


def test_beyond_what_was_measured_the_ratio_stays_what_it_was() -> None:
    depth, phase = np.array([1.2e-3, 3.0e-3]), np.full(2, DOWN)
    found, _ = compensate(np.ones((2, 3)), depth, phase, SOFT_SKIN, HARD_SKIN, 0.0, 1.0)
    assert found[0, 0] == pytest.approx(found[1, 0])


def test_axes_without_a_label_stay_so_and_count_for_no_choice() -> None:
    labels = np.column_stack([np.full(12, np.nan), np.linspace(0, 1, 12), -1e3 * DEPTH])
    phase = np.full(12, DOWN)
    found, _ = compensate(labels, DEPTH, phase, SOFT_SKIN, HARD_SKIN, 0.0, 1.0)
    whole, _ = compensate(np.nan_to_num(labels), DEPTH, phase, SOFT_SKIN, HARD_SKIN, 0.0, 1.0)
    assert np.isnan(found[:, 0]).all()
    assert np.array_equal(found[:, 1:], whole[:, 1:])
    choice = scored_choice(
        PairedLabels(labels, 2 * labels, DEPTH, phase), SOFT_SKIN, HARD_SKIN, 0.0, 0.0
    )
    assert choice.axes[0] is None
    assert choice.axes[1:] == pytest.approx(np.abs(labels[:, 1:]).mean(axis=0))
    assert choice.error == pytest.approx(np.linalg.norm(labels[:, 1:], axis=1).mean())


def test_published_coefficients_are_of_depth_in_mm_or_of_its_share() -> None:
    known = Compensation(down=(0.8, 4.0, 0.0), up=(-0.8, -4.0, 0.0))
    of_mm = prior_of_coefficients("r6", known, depth_range=1.2e-3, per_mm=True, source="csv")
    assert np.allclose(of_mm.loading.compression(DEPTH / 1.2e-3), 0.8e6 * DEPTH**2 + 4e3 * DEPTH)
    assert of_mm.loading.coefficients == of_mm.unloading.coefficients
    of_share = prior_of_coefficients("r6", known, depth_range=1.2e-3, per_mm=False, source="csv")
    assert of_share.loading.coefficients == (0.8, 4.0, 0.0)


def test_the_oracle_finds_what_made_the_labels() -> None:
    phase = np.full(12, DOWN)
    source = np.random.default_rng(1).normal(size=(12, 3))
    target, _ = compensate(source, DEPTH, phase, SOFT_SKIN, HARD_SKIN, 0.5, 0.75)
    best = best_for_labels(PairedLabels(source, target, DEPTH, phase), SOFT_SKIN, HARD_SKIN)
    assert (best.d0, best.weight) == (0.5, 0.75)
    assert best.error == pytest.approx(0.0, abs=1e-12)


def test_priors_that_fit_are_trusted_and_noise_is_not() -> None:
    assert best_for_priors(SOFT_SKIN, HARD_SKIN) == (0.0, 1.0)
    random = np.random.default_rng(2)
    noisy = []
    for name in ("one", "same"):
        curve = np.stack([DEPTH, SOFT[1] * DEPTH + random.normal(scale=1.0, size=12)], axis=1)
        noisy.append(fit_prior(ForceDepthCurve(name, "prism", "made up", curve, curve)))
    chosen = best_for_priors(noisy[0], noisy[1])
    assert chosen is not None
    assert chosen[1] < 0.5
    known = Compensation((1.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    untold = prior_of_coefficients("csv", known, depth_range=1e-3, per_mm=True, source="csv")
    assert best_for_priors(SOFT_SKIN, untold) is None


def test_a_recorded_session_has_the_curve_that_was_pressed(tmp_path: Path) -> None:
    curve = curve_of_session(record(tmp_path / "s.zarr", kind="taxels"))
    assert (curve.sensor, curve.indenter, curve.source) == ("uskin", "sphere", "session s.zarr")
    prior = fit_prior(curve)
    assert prior.depth_max == pytest.approx(1e-3, rel=0.1)
    fraction = np.array([0.25, 0.5, 0.75])
    # 3 N at 1 mm, linear below that.
    due = 3e3 * fraction * prior.depth_range
    for branch in (prior.loading, prior.unloading):
        assert np.allclose(branch.compression(fraction), due, atol=0.15)


SKINS: dict[str, Any] = {"indenters": ("cone", "prism"), "displacement": False, "force_depth": 1}
archive = archive_of(unloading=0.7, **SKINS)


def test_an_archive_of_skins_that_differ_by_a_factor_is_compensated_exactly(
    archive: MarkerArchive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "compensation.json"
    assert main(["compensate", str(archive.path), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "dots > grid" in printed
    assert "better in 2 of 2 pairs" in printed
    assert out.with_suffix(".png").stat().st_size > 10_000
    stored = read_stored(out)
    (pair,) = (pair for pair in stored.pairs if (pair.source, pair.target) == ("dots", "grid"))
    oracle = pair.choices["oracle"]
    # Labels belong to two presses of the one seen indenter, four phases each.
    assert pair.pairs == 8
    assert (oracle.d0, oracle.weight) == (0.0, 1.0)
    assert oracle.error == pytest.approx(0.0, abs=1e-9)
    assert oracle.r2 == pytest.approx(1.0)
    # Labels too small by a factor of 1.6 have a relative error of 0.375.
    both = paired_labels(archive, "dots", "grid")
    assert both is not None
    square = np.square(both.target)
    spread = square.sum(axis=0) - len(both) * both.target.mean(axis=0) ** 2
    assert pair.before.r2 == pytest.approx(np.mean(1 - 0.375**2 * square.sum(axis=0) / spread))
    assert pair.before.error is not None
    assert pair.choices["default"].error == pytest.approx(0.25 * pair.before.error, rel=1e-6)
    table = archive["dots"].table
    rows = (table["location"] >= 0) & (table["depth"] > 0)
    scaled, clamped = stored.pair("dots", "grid", "oracle").applied(
        table["wrench"][rows], table["depth"][rows], table["phase"][rows]
    )
    assert np.allclose(scaled, archive["grid"].table["wrench"][rows], atol=1e-9)
    assert clamped == 0


def test_a_target_without_labels_has_no_oracle_and_one_without_a_curve_no_pair(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "some.markers.zarr"
    made_up_archive(path, targets=1, unlabelled=("grid",), **SKINS)
    out = tmp_path / "c.json"
    assert main(["compensate", str(path), "--out", str(out)]) == 2
    assert "found force-depth curves of dots, expected two" in capsys.readouterr().err
    assert not out.exists()
    published = tmp_path / "published"
    published.mkdir()
    for half in ("down", "up"):
        (published / f"grid_{half}.csv").write_text("0.8,2.0,0.0\n")
    with_csv = ["compensate", str(path), "--out", str(out), "--coefficients", str(published)]
    assert main(with_csv) == 0
    assert "no target has labels" in capsys.readouterr().out
    (pair, _) = read_stored(out).pairs
    assert list(pair.choices) == ["default"]
    with pytest.raises(LearningError, match="has no choice 'oracle'"):
        read_stored(out).pair("dots", "grid", "oracle")


def test_another_file_is_never_overwritten_and_a_damaged_one_is_named(
    archive: MarkerArchive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "c.json"
    out.write_text("{}")
    assert main(["compensate", str(archive.path), "--out", str(out)]) == 2
    assert "exists and says something else" in capsys.readouterr().err
    assert out.read_text() == "{}"
    with pytest.raises(LearningError, match="format: found None"):
        read_stored(out)
    out.unlink()
    assert main(["compensate", str(archive.path), "--out", str(out)]) == 0
    content = json.loads(out.read_text())
    del content["priors"]["grid"]
    out.write_text(json.dumps(content))
    with pytest.raises(LearningError, match="grid has no prior"):
        read_stored(out)


@pytest.mark.slow
def test_labels_by_simulation_are_the_target_s_where_both_twins_are_wrong_alike(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "twins.markers.zarr"
    archive = made_up_archive(path, targets=2, frames_per_phase=2, force_depth=2)
    source, target = archive["dots"], archive["grid"]
    with pytest.raises(LearningError, match="dots: found no forces of a twin; allowed: tactile"):
        simulated_labels(source, target)
    assert simulated_r2(archive, "dots", "grid") is None
    for name, spread in (("dots", 0.1), ("grid", 0.2)):
        write_twin(archive, name, 0.9 * archive[name].table["wrench"][:, :3], spread)
    archive = MarkerArchive(path)
    assert list(check_archive(archive.files, path)) == []
    labels = simulated_labels(archive["dots"], archive["grid"])
    rows = source.table["location"] >= 0
    true = target.table["wrench"][rows, :3]
    np.testing.assert_allclose(labels.force[rows], true, atol=1e-9)
    assert np.isnan(labels.force[~rows]).all()
    pressed = rows & (np.abs(source.table["wrench"][:, 2]) > 0.1)
    np.testing.assert_allclose(labels.spread[pressed, 2], np.hypot(0.2, 1.6 * 0.1), rtol=1e-6)
    assert labels.made_from == "twin of dots; twin of grid"
    assert simulated_r2(archive, "dots", "grid") == pytest.approx(1.0)
    assert main(["compensate", str(path), "--out", str(tmp_path / "c.json")]) == 0
    printed = capsys.readouterr().out
    assert "R2 of labels, dots > grid: before" in printed
    assert "simulated 1.00" in printed
