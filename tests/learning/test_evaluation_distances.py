"""Distances of features against closed forms, and properties of the features."""

from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.evaluation.distribution import (
    FEATURES,
    MARKER_GRID,
    Inception,
    embedded,
    frechet_distance,
    kernel_distance,
    load_extractor,
    load_inception,
    mixing_score,
    squared_kernel_distance,
)


def exactly(mean: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return samples with exactly this mean and covariance."""
    drawn = np.random.default_rng(3).normal(size=(40, len(mean)))
    drawn -= drawn.mean(axis=0)
    white = drawn @ np.linalg.inv(np.linalg.cholesky(np.atleast_2d(np.cov(drawn.T)))).T
    return white @ np.linalg.cholesky(covariance).T + mean


def test_frechet_of_gaussians_on_a_line_is_that_of_mean_and_deviation() -> None:
    one = exactly(np.array([1.0]), np.array([[4.0]]))
    other = exactly(np.array([4.0]), np.array([[0.25]]))
    assert frechet_distance(one, other) == pytest.approx(9 + (2 - 0.5) ** 2)


def test_frechet_of_gaussians_in_a_plane_is_the_closed_form() -> None:
    first = np.array([[2.0, 0.7], [0.7, 1.0]])
    second = np.array([[1.0, -0.4], [-0.4, 3.0]])
    product = first @ second
    # Trace of the square root of a 2 x 2 matrix, from its trace and determinant.
    root = np.sqrt(np.trace(product) + 2 * np.sqrt(np.linalg.det(product)))
    expected = 5 + np.trace(first) + np.trace(second) - 2 * root
    mean = np.array([1.0, 2.0])
    found = frechet_distance(exactly(np.zeros(2), first), exactly(mean, second))
    assert found == pytest.approx(expected)


def test_frechet_keeps_its_digits_with_fewer_samples_than_features() -> None:
    few = np.random.default_rng(0).normal(size=(8, 50))
    assert frechet_distance(few, few) == pytest.approx(0, abs=1e-12)
    middle, spread = few.mean(axis=0), few.var(axis=0, ddof=1).sum()
    wider = middle + 1.001 * (few - middle)
    assert frechet_distance(few, wider) == pytest.approx(1e-6 * spread, rel=1e-6)


def test_the_kernel_distance_is_the_unbiased_sum_over_pairs() -> None:
    one = np.array([[1.0, 0.0], [0.0, 2.0], [1.0, 1.0]])
    other = np.array([[3.0, 0.0], [0.0, 0.0]])

    def kernel(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
        return float((a @ b / 2 + 1) ** 3)

    within = sum(kernel(one[i], one[j]) for i in range(3) for j in range(3) if i != j) / 6
    beyond = sum(kernel(other[i], other[j]) for i in range(2) for j in range(2) if i != j) / 2
    across = sum(kernel(a, b) for a in one for b in other) / 6
    assert squared_kernel_distance(one, other) == pytest.approx(within + beyond - 2 * across)


def test_the_kernel_distance_of_one_distribution_strays_about_zero() -> None:
    drawn = np.random.default_rng(1).normal(size=(600, 4))
    mean, spread = kernel_distance(drawn[:300], drawn[300:], size=50, subsets=60, seed=0)
    assert abs(mean) < spread
    apart, _ = kernel_distance(drawn[:300], drawn[300:] + 2, size=50, subsets=60, seed=0)
    assert apart > 10 * spread


def test_sets_far_apart_do_not_mix_and_equal_ones_mix_fully() -> None:
    drawn = np.random.default_rng(4).normal(size=(600, 2))
    assert mixing_score(drawn[:300], drawn[300:] + 50) == 0
    assert mixing_score(drawn[:400], drawn[400:]) == pytest.approx(1, abs=0.1)


def test_the_mixing_score_is_the_share_of_foreign_neighbours_over_chance() -> None:
    one, other = np.array([[0.0], [1.0]]), np.array([[1.1], [5.0]])
    # Nearest neighbours: 1.0, 1.1 (other), 1.0 (other), 1.1; by chance 2 of 3 are of the other set.
    assert mixing_score(one, other, neighbours=1) == pytest.approx(0.5 / (2 / 3))


def test_an_embedding_is_the_same_for_a_seed() -> None:
    drawn = np.random.default_rng(5).normal(size=(20, 5))
    one, again = embedded(drawn, seed=0), embedded(drawn, seed=0)
    assert one.shape == (20, 2)
    assert one.tolist() == again.tolist()


def test_the_marker_grid_tells_what_is_set_where_and_how_much_is_edge() -> None:
    image = np.zeros((1, 256, 256), np.uint8)
    image[0, 32:64, 96:112] = 255  # the left half of one cell, second row and fourth column
    coverage, column, row, edge = MARKER_GRID.features(image).reshape(4, 8, 8)
    assert coverage[1, 3] == pytest.approx(0.5)
    assert coverage.sum() == pytest.approx(0.5)
    assert column[1, 3] == pytest.approx(np.linspace(-1, 1, 32)[:16].mean() / 2)
    assert row[1, 3] == pytest.approx(0)
    # The right half-end and the lower end; the left end belongs to the previous cell.
    assert edge[1, 3] == pytest.approx((32 + 16) / 1024)
    assert edge[1, 2] == pytest.approx(32 / 1024)
    with pytest.raises(LearningError, match="allowed: uint8"):
        MARKER_GRID.features(np.zeros((2, 128, 128), np.uint8))


def test_inception_has_the_parameters_that_were_published() -> None:
    with torch.device("meta"):
        network = Inception()
    # Inception v3 without its auxiliary head and its 1000 classes: 23,834,568 - 2,049,000.
    assert sum(each.numel() for each in network.parameters()) == 21_785_568
    names = network.state_dict().keys()
    assert {"Mixed_7c.branch3x3dbl_3b.bn.running_var", "Mixed_5b.branch_pool.conv.weight"} <= names


@pytest.mark.slow
def test_inception_makes_features_of_weights_in_its_layout(tmp_path: Path) -> None:
    torch.manual_seed(0)
    weights = Inception().state_dict()
    weights |= {"fc.weight": torch.zeros(1008, FEATURES), "fc.bias": torch.zeros(1008)}
    torch.save(weights, tmp_path / "inception.pth")
    extractor = load_extractor(str(tmp_path / "inception.pth"))
    assert extractor.name.startswith("inception@")
    images = np.random.default_rng(0).integers(0, 255, (2, 256, 256), np.uint8)
    assert extractor.features(images).shape == (2, FEATURES)


def test_features_are_named_and_weights_of_something_else_are_refused(tmp_path: Path) -> None:
    assert load_extractor("marker-grid").name == "marker-grid-8x8"
    with pytest.raises(LearningError, match="allowed: marker-grid"):
        load_extractor("/nowhere/at-all.pth")
    torch.save({"layer.weight": torch.zeros(2)}, tmp_path / "other.pth")
    with pytest.raises(LearningError, match="allowed: the weights of Inception"):
        load_inception(tmp_path / "other.pth")
    (tmp_path / "none.pth").write_bytes(b"nothing")
    with pytest.raises(LearningError, match=r"none\.pth: found no weights"):
        load_inception(tmp_path / "none.pth")
