"""Bonded layer far from its edges, a function of height only: sag and natural frequencies.

Contact frame: z from -h (bonded) to 0 (free). Small strain. It applies to a block at several
heights from the nearest side: the effect of the edge decays as exp(-b x/h), b from `edge_decay`
(0.78 at nu = 0.45), to 1 % at 6 h.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def oedometric_modulus(modulus: float, poisson: float) -> float:
    """Return M = E (1 - nu) / ((1 + nu)(1 - 2 nu)) [Pa]: confined stress over strain."""
    return modulus * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson))


def layer_sag(
    z: ArrayLike,
    acceleration: Sequence[float],
    thickness: float,
    density: float,
    modulus: float,
    poisson: float,
) -> Array:
    """Return the displacement (..., 3) at height `z` under a uniform acceleration (x, y, z) [m].

    u_i = density a_i (h^2 - z^2) / (2 C_i), C = (G, G, M): the solution of C u'' + density a = 0,
    u(-h) = 0, u'(0) = 0. The top sinks by density g h^2 / (2 M).
    """
    shear = modulus / (2 * (1 + poisson))
    stiffness = np.array([shear, shear, oedometric_modulus(modulus, poisson)])
    profile = (thickness**2 - np.square(np.asarray(z, float))) / 2
    sag: Array = profile[..., None] * density * np.asarray(acceleration, float) / stiffness
    return sag


def shear_frequency(
    thickness: float, density: float, modulus: float, poisson: float, *, overtone: int = 0
) -> float:
    """Return the frequency of lateral vibration [Hz]: (2 n + 1) c_s / (4 h), c_s = sqrt(G/density).

    A standing wave with a node at the base and a free top; n = `overtone`, 0 for the lowest mode.
    """
    speed = math.sqrt(modulus / (2 * (1 + poisson)) / density)
    return (2 * overtone + 1) * speed / (4 * thickness)


def compression_frequency(
    thickness: float, density: float, modulus: float, poisson: float, *, overtone: int = 0
) -> float:
    """Return the vertical frequency [Hz]: (2 n + 1) c_p / (4 h), c_p = sqrt(M / density)."""
    speed = math.sqrt(oedometric_modulus(modulus, poisson) / density)
    return (2 * overtone + 1) * speed / (4 * thickness)
