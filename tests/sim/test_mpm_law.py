"""The constitutive law in the displacement gradient: equal to `sim.scene`'s, exact at rest."""

# Warp reads the annotations of kernels as values: no `from __future__ import annotations` here.
from typing import Any

import numpy as np
import pytest
import warp as wp
from support import mpm_oracle as oracle
from support.mpm_oracle import Array

from sim.mpm.state import law_functions
from sim.scalars import matrix_of, numpy_of

SHEAR, BULK = 0.7, 3.1


def _of_law(gradients: Array, real: Any) -> tuple[Array, Array, Array]:
    """Return Det(F) - 1 (N,), Kirchhoff stress (N, 3, 3), energy (N,) of gradients (N, 3, 3)."""
    dilatation, kirchhoff, energy = law_functions(real)
    mat33 = matrix_of(real)

    @wp.kernel(enable_backward=False, module="unique")
    def law(
        # In:
        gradient: wp.array(dtype=mat33),
        # Out:
        grown_out: wp.array(dtype=real),
        stress_out: wp.array(dtype=mat33),
        energy_out: wp.array(dtype=real),
    ):
        i = wp.tid()
        h = gradient[i]
        grown_out[i] = dilatation(h)
        stress_out[i] = kirchhoff(h, real(SHEAR), real(BULK))
        energy_out[i] = energy(h, real(SHEAR), real(BULK))

    count = len(gradients)
    given = wp.array(gradients.astype(numpy_of(real)), dtype=mat33, device="cpu")
    grown, energies = (wp.zeros(count, dtype=real, device="cpu") for _ in range(2))
    stress = wp.zeros(count, dtype=mat33, device="cpu")
    wp.launch(law, count, [given], [grown, stress, energies], device="cpu")
    return grown.numpy().astype(float), stress.numpy().astype(float), energies.numpy().astype(float)


def _energy(gradient: Array) -> float:
    f = np.eye(3) + gradient
    det = np.linalg.det(f)
    isochoric = SHEAR / 2 * (det ** (-2 / 3) * np.trace(f.T @ f) - 3)
    return float(isochoric + BULK / 2 * ((det**2 - 1) / 2 - np.log(det)))


RANDOM = np.random.default_rng(5).uniform(-0.25, 0.25, (20, 3, 3))


def test_stress_and_energy_are_those_of_the_stated_law() -> None:
    grown, stress, energy = _of_law(RANDOM, wp.float64)
    for k, gradient in enumerate(RANDOM):
        assert grown[k] == pytest.approx(np.linalg.det(np.eye(3) + gradient) - 1, abs=1e-14)
        assert energy[k] == pytest.approx(_energy(gradient), rel=1e-12)
        wanted = oracle.kirchhoff(gradient, SHEAR, BULK)
        np.testing.assert_allclose(stress[k], wanted, atol=1e-13)


def test_stress_is_the_derivative_of_the_energy() -> None:
    step = 1e-6
    gradient = RANDOM[0]
    moves = step * np.eye(9).reshape(9, 3, 3)
    both = np.concatenate([gradient + moves, gradient - moves])
    _, _, energy = _of_law(both, wp.float64)
    first_piola = ((energy[:9] - energy[9:]) / (2 * step)).reshape(3, 3)
    _, stress, _ = _of_law(gradient[None], wp.float64)
    np.testing.assert_allclose(first_piola @ (np.eye(3) + gradient).T, stress[0], atol=1e-8)


@pytest.mark.parametrize("real", [wp.float32, wp.float64])
def test_at_rest_there_is_no_stress_at_all(real: Any) -> None:
    grown, stress, energy = _of_law(np.zeros((1, 3, 3)), real)
    assert not grown.any()
    assert not stress.any()
    assert not energy.any()


def test_float32_keeps_its_digits_at_small_strain() -> None:
    tiny = 1e-5 * RANDOM[:3]
    _, stress, _ = _of_law(tiny, wp.float32)
    _, wanted, _ = _of_law(tiny, wp.float64)
    np.testing.assert_allclose(stress, wanted, atol=3e-6 * np.abs(wanted).max())
