"""Errors measured by two meshes: for a tolerance, and for an error bar."""

from __future__ import annotations

import numpy as np
import pytest

from sim import Layer, Measured, Mpm, plan, simulate, tolerance
from sim.errors import SceneError
from sim.fem.numerics import Fem
from sim.indenters import sphere
from sim.scene import Body, Scene, press

BALL = Scene(sphere(4e-3), press([0.3e-3, 0.6e-3]), Body(12e-3, 12e-3))
FINE = Fem(spacing=0.4e-3)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """Force with elements of 0.4 mm, with the remaining error extrapolated from 0.8 mm."""
    fine, coarse = (simulate(BALL, one).force for one in (FINE, Fem(spacing=0.8e-3)))
    return fine + (fine - coarse) / 3


@pytest.mark.slow
@pytest.mark.parametrize(
    "tier", [Fem(spacing=0.8e-3), pytest.param(Fem(), marks=pytest.mark.slow), Layer()]
)
def test_an_error_bar_covers_the_error(truth: np.ndarray, tier: Fem | Layer) -> None:
    result = simulate(BALL, Measured(tier))
    error = result.record["error"]
    assert error["status"] == "measured"
    off = np.abs(result.force - truth)[1:].max(axis=1) / np.linalg.norm(truth[1:], axis=1)
    assert (off <= np.array(error["force"])[1:] + 2e-3).all()
    assert error["percent"] < 100 * 12 * max(off.max(), 1e-3)
    assert result.record["error_bar"]["force_share"] == error["percent"] / 100
    assert result.record["error_bar"]["second_mesh"] == error["second_mesh"]


def test_a_mesh_without_a_coarser_one_has_no_error_bar() -> None:
    with pytest.raises(SceneError, match=r"error_bar: a mesh of \d+ x \d+ x 3 elements; allowed:"):
        simulate(BALL, Measured(Fem(spacing=4e-3 / 3)))


def test_particles_have_no_error_bar() -> None:
    with pytest.raises(SceneError, match=r"measured\.tier: Mpm\(.*; allowed: a Fem or a Layer"):
        Measured(Mpm())  # type: ignore[arg-type]


def test_a_tolerance_is_kept(truth: np.ndarray) -> None:
    result = plan(BALL, "2 %").run()
    assert result.record["error"]["percent"] <= 2
    np.testing.assert_allclose(result.force[:, 2], truth[:, 2], rtol=0.02)


@pytest.mark.slow
def test_one_that_the_meshes_allowed_do_not_reach_is_refused_with_what_they_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(tolerance.ELEMENTS_MAX, "cpu", 26_000)
    with pytest.raises(
        SceneError, match=r"tolerance: '0\.11 %'; tried: .*; allowed: [\d.]+ % or m"
    ):
        plan(BALL, "0.11 %").run()


@pytest.mark.slow
def test_the_limit_on_elements_leaves_a_coarser_mesh_to_measure_by(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(tolerance.ELEMENTS_MAX, "cpu", 1000)
    scene = Scene(sphere(4e-3), press([0.3e-3]))
    error = plan(scene, "8 %", only="fem").run().record["error"]
    assert error["second_mesh"]["elements"] < 0.6 * 1000
    with pytest.raises(SceneError, match=r"fineness 0\.6: 5\.\d+ %; allowed: 5\.\d+ % or more"):
        plan(scene, "3 %", only="fem").run()


def test_meshes_too_much_alike_tell_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(tolerance.ELEMENTS_MAX, "cpu", 1000)
    monkeypatch.setattr(tolerance, "RATIO_LEAST", 9.0)
    with pytest.raises(SceneError, match=r"no coarser mesh to measure by; allowed: none"):
        plan(BALL, "0.3 %").run()
