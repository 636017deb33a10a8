# Warp reads the annotations of kernels as values: no `from __future__ import annotations` here.
from functools import cache
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray

from sim.indenters import NAMES, Indenter, named, plane, rounded_cone
from sim.indenters.device import FAR, PartTable, distance_function, table_struct

Array = NDArray[np.float64]

UNIT = 4e-3
DEVICES = [
    "cpu",
    pytest.param(
        "cuda:0",
        marks=[
            pytest.mark.gpu,
            pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device"),
        ],
    ),
]
ALL = [named(name) for name in NAMES]
SHARP = [named(name, 0.0) for name in NAMES]
MORE = [plane(), rounded_cone(0.5, 0.1e-3)]


@cache
def _kernel(real: Any) -> Any:
    distance = distance_function(real)

    @wp.kernel(enable_backward=False, module="unique")
    def gaps(
        # In:
        table: table_struct(real),
        points: wp.array2d[wp.types.vector(3, real)],
        # Out:
        found_out: wp.array2d[wp.types.vector(4, real)],
    ):
        environment, point = wp.tid()
        found_out[environment, point] = distance(table, environment, points[environment, point])

    return gaps


def _on_device(
    indenters: list[Indenter], points: Array, real: Any, device: str, far: float = FAR
) -> tuple[Array, Array]:
    """Gap [m] and normal of points (environments, N, 3) [m], one indenter an environment."""
    table = PartTable.pack(indenters, UNIT, real, device, far=far)
    given = wp.array(points / UNIT, dtype=wp.types.vector(3, real), device=device)
    found = wp.zeros(given.shape, dtype=wp.types.vector(4, real), device=device)
    wp.launch(_kernel(real), given.shape, [table.struct, given], [found], device=device)
    result = found.numpy().astype(float)
    return result[..., 3] * UNIT, result[..., :3]


def _cloud(environments: int, count: int) -> Array:
    rng = np.random.default_rng(7)
    low, high = [-9e-3, -9e-3, -2e-3], [9e-3, 9e-3, 5e-3]
    return rng.uniform(low, high, (environments, count, 3))


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("real", "gap_error", "normal_error"),
    [(wp.float32, 1e-5, 1e-3), (wp.float64, 1e-12, 1e-10)],
    ids=["float32", "float64"],
)
def test_any_mix_of_indenters_in_one_launch_gives_the_gaps_of_the_oracle(
    real: Any, gap_error: float, normal_error: float, device: str
) -> None:
    indenters = ALL + SHARP + MORE
    points = _cloud(len(indenters), 3000)
    gaps, normals = _on_device(indenters, points, real, device)
    for indenter, cloud, gap, normal in zip(indenters, points, gaps, normals, strict=True):
        true, true_normal = indenter.distance(cloud)
        near = (true < FAR) & (gap < FAR)
        assert near.sum() > 50, indenter.name
        np.testing.assert_allclose(gap[near], true[near], rtol=0, atol=gap_error * UNIT)
        # Where two faces are as near as rounding can tell, either normal is right.
        apart = np.abs(normal - true_normal)[near].max(axis=1) > normal_error
        assert apart.mean() < 1e-3, indenter.name


def test_far_away_the_gap_is_a_lower_bound_that_is_far_too() -> None:
    points = _cloud(len(ALL), 3000)
    gaps, _ = _on_device(ALL, points, wp.float64, "cpu")
    exact, _ = _on_device(ALL, points, wp.float64, "cpu", far=1.0)
    bound = gaps != exact
    assert bound.mean() > 0.2
    assert np.all(gaps[bound] > FAR)
    # Beside an oblique edge the oracle's gap is of first order only, so it may be the lesser one.
    assert np.quantile(gaps[bound] / exact[bound], 0.999) < 1.001
    assert np.max(gaps[bound] / exact[bound]) < 1.05


def test_a_single_indenter_without_a_path_will_do() -> None:
    points = _cloud(1, 100)
    gaps, _ = _on_device([named("sphere")], points, wp.float64, "cpu", far=1.0)
    np.testing.assert_allclose(gaps[0], named("sphere").distance(points[0])[0], atol=1e-15)


def test_equal_indenters_are_stored_once() -> None:
    table = PartTable.pack([named("moon"), plane(), named("moon")], UNIT, wp.float32, "cpu")
    assert table.count == 3
    assert table.struct.indenter.numpy().tolist() == [0, 1, 0]
    assert table.struct.first.numpy().tolist() == [0, 2, 3]
