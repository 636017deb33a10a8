"""uSkin: dipoles over Hall elements, counts, and the discs drawn from them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from recorder.markers import draw_discs, find_blobs
from sim.indenters import named
from sim.layer import Layer
from sim.result import Result
from sim.scene import Effects, Friction, Scene, through
from sim.sensors import SurfaceField, TaxelPad, TaxelSignal, readout, sensor
from sim.sensors.taxels import flux_density, rotations
from sim.tiers import simulate

Array = NDArray[np.float64]

BODY = sensor("uskin").body
FOUND = sensor("uskin").signal
assert isinstance(FOUND, TaxelSignal)
SIGNAL = FOUND
MU_0 = 4e-7 * math.pi


def dipole(moment: Array, apart: Array) -> Array:
    """Return Jackson's formula with unit vectors, in the opposite convention."""
    distance = math.sqrt(sum(float(value) ** 2 for value in apart))
    unit = apart / distance
    along = sum(float(m) * float(n) for m, n in zip(moment, unit, strict=True))
    return MU_0 / (4 * math.pi * distance**3) * (3 * along * unit - moment)


def pressed(x: float, y: float, aside: float = 0.0) -> Result:
    motion = through([(x, y, 0.0), (x, y, -1e-3), (x + aside + 1e-9, y, -1e-3)], speed=5e-3)
    scene = Scene(named("prism"), motion, body=BODY, effects=Effects(friction=Friction(0.5)))
    return simulate(scene, Layer())


def test_an_undeformed_pad_counts_nothing_and_draws_16_discs_of_481_px() -> None:
    reader = readout(sensor("uskin"))
    still = SurfaceField.undeformed(BODY)
    assert not TaxelPad(BODY, SIGNAL).counts(still).any()
    blobs = find_blobs(reader.masks(still)[:, 0])
    assert len(blobs.area) == 16
    assert np.abs(np.asarray(blobs.area) - 481).max() <= 2


def test_magnets_that_only_move_give_the_dipole_formulas_counts() -> None:
    pad = TaxelPad(BODY, SIGNAL)
    shift = np.array([0.2e-3, -0.1e-3, -0.3e-3])
    found = pad.flux(np.broadcast_to(shift, (1, 16, 3)), np.zeros((1, 16, 3, 3)))[0]
    height = -SIGNAL.magnet_depth + BODY.thickness + SIGNAL.hall_depth
    moment = np.array([0.0, 0.0, SIGNAL.moment])
    for hall in range(16):
        total = np.zeros(3)
        for magnet in range(16):
            steps = [hall % 4 - magnet % 4, hall // 4 - magnet // 4]
            apart = np.array([*(SIGNAL.pitch * np.array(steps)), -height]) - shift
            total += dipole(moment, apart)
        np.testing.assert_allclose(found[hall], total, rtol=1e-9)


def test_a_turned_magnet_gives_a_turned_field() -> None:
    """Rotating magnet and position by the same angle rotates the field by that angle."""
    angle = 0.3
    turn = np.array(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]]
    )
    moment, place = np.array([[0.0, 0.0, 1e-3]]), np.array([[0.5e-3, 0.2e-3, -3e-3]])
    straight = flux_density(moment, np.zeros((1, 3)), place)
    turned = flux_density(moment @ turn.T, np.zeros((1, 3)), place @ turn.T)
    np.testing.assert_allclose(turned, straight @ turn.T, rtol=1e-12)


def test_rotations_leave_out_the_stretch() -> None:
    angle = 0.4
    turn = np.array(
        [[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]]
    )
    stretch = np.array([[1.3, 0.1, 0.0], [0.1, 0.8, 0.05], [0.0, 0.05, 0.9]])
    np.testing.assert_allclose(rotations(turn @ stretch - np.eye(3)), turn, atol=1e-12)
    assert np.linalg.det(rotations(np.diag([0.0, 0.0, -1.5]))) == pytest.approx(1.0)


def test_taxels_lie_at_i_mod_4_and_i_div_4_and_feel_what_presses_them() -> None:
    pad = TaxelPad(BODY, SIGNAL)
    np.testing.assert_allclose(SIGNAL.places[6], [0.5 * 4.7e-3, -0.5 * 4.7e-3], atol=1e-12)
    x, y = SIGNAL.places[6]
    assert pad.counts(SurfaceField.of(pressed(x, y)))[1][:, 2].argmax() == 6


@pytest.fixture(scope="module")
def sheared() -> tuple[Result, Result]:
    """Pushed along +x at (3, 2) mm, and the mirror image at (-3, 2) mm."""
    return pressed(3e-3, 2e-3, 1e-3), pressed(-3e-3, 2e-3, -1e-3)


def test_mirrored_presses_mirror_the_counts(sheared: tuple[Result, Result]) -> None:
    pad = TaxelPad(BODY, SIGNAL)
    here, there = (pad.counts(SurfaceField.of(result)) for result in sheared)
    mirrored = here.reshape(-1, 4, 4, 3)[:, :, ::-1].reshape(-1, 16, 3) * [-1, 1, 1]
    assert np.abs(there - mirrored).max() <= 0.002 * np.abs(here).max()


def test_full_presses_use_the_range_of_the_discs(sheared: tuple[Result, Result]) -> None:
    counts = TaxelPad(BODY, SIGNAL).counts(SurfaceField.of(sheared[0]))
    size = 300 + 0.2 * counts[1, :, 2].max()
    assert 3 * 300 < size < 6000
    assert 0.1 < 2e-4 * counts[2, :, 0].max() < 0.6
    assert len(find_blobs(draw_discs(counts)[2:]).area) == 16


def test_shear_moves_discs_the_way_the_skin_goes(sheared: tuple[Result, Result]) -> None:
    counts = TaxelPad(BODY, SIGNAL).counts(SurfaceField.of(sheared[0]))
    change = counts[2, :, 0] - counts[1, :, 0]
    # Under the centre the magnet turns as far as it moves: counts change little, neighbours more.
    assert change.sum() > 1000
    assert change.max() > 3 * -change.min()


def test_noise_has_the_stated_deviation_and_is_the_same_for_a_frame_each_time() -> None:
    reader = readout(sensor("uskin"), seed=7)
    still = SurfaceField.undeformed(BODY)
    many = replace(still, displacement=np.repeat(still.displacement, 400, axis=0))
    counts = reader.counts(many)  # type: ignore[union-attr]
    # Rounding to whole counts adds 1/12 to the variance.
    deviation = math.sqrt(SIGNAL.noise**2 + 1 / 12)
    assert counts.std() == pytest.approx(deviation, rel=0.02)
    assert abs(counts.mean()) < 4 * deviation / math.sqrt(counts.size)
    np.testing.assert_array_equal(reader.counts(still, first=17)[0], counts[17])  # type: ignore[union-attr]


def test_counts_saturate_and_are_whole() -> None:
    loud = replace(SIGNAL, gain_normal=1e9, gain_shear=1e9)
    raw = TaxelPad(BODY, loud).raw(SurfaceField.of(pressed(0.0, 0.0)))
    assert raw.dtype == np.int32
    assert raw.min() == 0
    assert raw.max() == 65535
