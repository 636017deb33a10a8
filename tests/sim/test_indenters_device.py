# Warp reads the annotations of kernels as values: no `from __future__ import annotations` here.
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from numpy.typing import NDArray
from support import stl_files as files
from support.devices import DEVICES
from support.machine_code import machine_code

from sim.indenters import NAMES, Indenter, from_stl, named, plane, rounded_cone
from sim.indenters.device import (
    FAR,
    PLAIN,
    IndenterTraits,
    PartTable,
    distance_function,
    table_struct,
    traits_of,
)

Array = NDArray[np.float64]

UNIT = 4e-3
ALL = [named(name) for name in NAMES]
SHARP = [named(name, 0.0) for name in NAMES]
MORE = [plane(), rounded_cone(0.5, 0.1e-3)]


@cache
def _kernel(real: Any, traits: IndenterTraits = PLAIN) -> Any:
    distance = distance_function(real, traits)

    @wp.kernel(enable_backward=False, module="unique")
    def gaps(
        # In:
        table: table_struct(real, traits),
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
    kernel = _kernel(real, table.traits)
    wp.launch(kernel, given.shape, [table.struct, given], [found], device=device)
    result = found.numpy().astype(float)
    return result[..., 3] * UNIT, result[..., :3]


def _cloud(environments: int, count: int) -> Array:
    rng = np.random.default_rng(7)
    low, high = [-9e-3, -9e-3, -2e-3], [9e-3, 9e-3, 5e-3]
    return rng.uniform(low, high, (environments, count, 3))


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Indenter:
    path = tmp_path_factory.mktemp("stl") / "block.stl"
    files.write_binary(path, files.block(3, 4, 5))
    return from_stl(path, edge_radius=0.4e-3, spacing=0.15e-3, reach=4e-3)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("real", [wp.float32, wp.float64], ids=["float32", "float64"])
@pytest.mark.parametrize(
    "kind", ["by name", "alone", pytest.param("files and leaning", marks=pytest.mark.slow)]
)
def test_any_mix_of_indenters_in_one_launch_gives_the_gaps_of_the_oracle(
    kind: str, real: Any, device: str, block: Indenter
) -> None:
    mixes = {
        "by name": ALL + SHARP + MORE,
        "alone": [named("sphere")],
        "files and leaning": [
            block,
            named("wave").tilted(0.1, -0.2),
            block.tilted(-0.1, 0.05),
            named("moon"),
        ],
    }
    indenters = mixes[kind]
    gap_error, normal_error = (1e-5, 1e-3) if real is wp.float32 else (1e-12, 1e-10)
    points, apart_most = _cloud(len(indenters), 3000), 1e-3
    if kind == "files and leaning":
        points *= [0.4, 0.4, 0.8]
        normal_error, apart_most = (2e-3 if real is wp.float32 else 1e-9), 2e-3
    gaps, normals = _on_device(indenters, points, real, device)
    for indenter, cloud, gap, normal in zip(indenters, points, gaps, normals, strict=True):
        true, true_normal = indenter.distance(cloud)
        near = (true < FAR) & (gap < FAR)
        assert near.sum() > 50, indenter.name
        np.testing.assert_allclose(gap[near], true[near], rtol=0, atol=gap_error * UNIT)
        # Where two faces are equally near up to rounding, either normal is right.
        apart = np.abs(normal - true_normal)[near].max(axis=1) > normal_error
        assert apart.mean() < apart_most, indenter.name


@pytest.mark.parametrize(
    "indenters",
    [ALL, [named("prism").tilted(0.2, 0.1), named("cone").tilted(-0.1, 0.3)]],
    ids=["upright", "leaning"],
)
def test_far_away_the_gap_is_a_lower_bound_that_is_far_too(indenters: list[Indenter]) -> None:
    points = _cloud(len(indenters), 3000)
    gaps, _ = _on_device(indenters, points, wp.float64, "cpu")
    exact, _ = _on_device(indenters, points, wp.float64, "cpu", far=1.0)
    bound = gaps != exact
    assert bound.mean() > 0.2
    assert np.all(gaps[bound] > FAR)
    # Next to an oblique edge the oracle's gap is only first-order accurate, so it may be smaller.
    assert np.quantile(gaps[bound] / exact[bound], 0.999) < 1.001
    assert np.max(gaps[bound] / exact[bound]) < 1.05


def test_equal_indenters_are_stored_once() -> None:
    table = PartTable.pack([named("moon"), plane(), named("moon")], UNIT, wp.float32, "cpu")
    assert table.struct.indenter.numpy().tolist() == [0, 1, 0]
    assert table.struct.first.numpy().tolist() == [0, 2, 3]


def test_beside_others_that_lean_an_upright_indenter_keeps_every_bit() -> None:
    points = np.repeat(_cloud(1, 3000), 2, axis=0)
    alone = _on_device([named("moon"), plane()], points, wp.float32, "cpu")
    beside = _on_device([named("moon"), named("wave").tilted(0.1, 0.0)], points, wp.float32, "cpu")
    for found, expected in zip(beside, alone, strict=True):
        np.testing.assert_array_equal(found[0], expected[0])


@pytest.mark.slow
def test_what_no_indenter_has_is_compiled_out_and_stored_nowhere(block: Indenter) -> None:
    sizes = [
        len(machine_code(_kernel(wp.float64, traits)))
        for traits in (PLAIN, traits_of([block]), traits_of([block.tilted(0.1, 0)]))
    ]
    assert 0 < sizes[0] < sizes[1] < sizes[2]
    table = PartTable.pack([named("moon")], UNIT, wp.float64, "cpu")
    assert not hasattr(table.struct, "turn")
    assert not hasattr(table.struct, "field")


def test_a_body_from_a_file_is_stored_once_however_it_leans(
    block: Indenter, tmp_path: Path
) -> None:
    files.write_binary(tmp_path / "ball.stl", files.ball(1.0, 9))
    ball = from_stl(tmp_path / "ball.stl", edge_radius=0.0, spacing=0.2e-3, reach=2e-3)
    many = [block, block.tilted(-0.1, 0.05), plane(), ball]
    table = PartTable.pack(many, UNIT, wp.float32, "cpu").struct
    assert block.solid is not None
    assert ball.solid is not None
    first = block.solid.distances(block.edge_radius).grid.count
    second = ball.solid.distances(0.0).grid.count
    assert table.field_first.numpy().tolist() == [0, 0, -1, first]
    assert table.field.shape == (first + second,)
