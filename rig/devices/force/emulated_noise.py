"""Noise of the emulated F/T sensors."""

import numpy as np
import numpy.typing as npt

# Rows of the table, which is used from the beginning again after its end.
NOISE_ROWS = 8192
# N m of torque noise per N of force noise: the ratio of a Nano17's resolutions.
_TORQUE_NOISE = 0.005


def noise_table(seed: int, force: float) -> npt.NDArray[np.float64]:
    """Return wrenches (NOISE_ROWS, 6) [N, N m] whose forces have the standard deviation `force`."""
    noise = np.random.default_rng(seed).normal(0.0, force, (NOISE_ROWS, 6))
    noise[:, 3:] *= _TORQUE_NOISE
    return noise
