import math

import numpy as np
import pytest

from benchmarks.independent.comparison import compared, scene_of
from benchmarks.independent.presses import PRESSES, Press
from sim import Body, Layer, Scene, press, simulate
from sim.indenters import flat_punch, rounded_cone, sphere
from tests.support.few import few

SOME = ("sphere 4 in 4", "sphere 0.5", "punch")


@pytest.mark.parametrize(
    "exact",
    few([press for press in PRESSES if press.axisymmetric and press.name.startswith(SOME)], 8),
    ids=lambda press: press.name,
)
def test_what_layer_says_of_its_error_covers_the_truth(exact: Press) -> None:
    for row in compared(Layer(), "cpu", exact):
        assert abs(row["error_percent"]) <= row["stated_percent"] + row["truth_percent"]


def test_a_contact_smaller_than_a_pixel_is_no_force_without_an_error() -> None:
    result = simulate(Scene(sphere(0.5e-3), press([50e-6]), Body(60e-3, 60e-3, 20e-3)), Layer())
    assert not result.force.any()
    assert result.record["error"]["percent"] == 100.0


def test_a_force_of_a_pixel_that_is_hardly_covered_is_off_as_a_whole() -> None:
    body = Body(162e-3, 162e-3, 20e-3)
    result = simulate(Scene(flat_punch(1e-3, 0.5e-3), press([1e-4, 5e-4]), body), Layer())
    # 0.022 N by independent axisymmetric finite elements, friction 0.3.
    assert abs(result.force[1, 2]) < 0.01
    assert result.record["error"]["force"][1] >= 1.0


@pytest.mark.slow
def test_a_force_whose_contact_is_smaller_than_an_element_is_off_as_a_whole() -> None:
    from sim.fem import Fem

    body = Body(19.7e-3, 7.86e-3, 4.16e-3, poisson=0.49)
    beside = press([1.29e-3], at=(11e-3, 1.75e-3))  # a rounded tip that grazes the upper edge
    result = simulate(
        Scene(rounded_cone(math.radians(31.4), 0.65312e-3), beside, body), Fem(fineness=0.22)
    )
    assert result.force.any()
    assert result.record["mesh"]["resolved"] == [None, None]
    assert result.record["error"]["percent"] >= 100.0


def test_what_fem_says_of_its_error_covers_the_truth_on_a_coarse_mesh() -> None:
    from sim.fem import Fem

    exact = next(press for press in PRESSES if press.name == "sphere 4 in 4, mu 0, nu 0.45, to 1.5")
    result = simulate(scene_of(exact), Fem(fineness=0.3))
    off = np.abs(result.force[1:, 2] / np.array(exact.forces_n)[:, 2] - 1)
    assert (off <= np.array(result.record["error"]["force"])[1:] + 0.003).all()
