"""Marker images of taxels: counts less the untouched ones, drawn as discs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from learning.markers.preset import TaxelPreset
from recorder.markers import draw_discs

_SIDE = 4


def taxel_masks(
    counts: NDArray[np.floating | np.integer],
    untouched: NDArray[np.floating | np.integer],
    preset: TaxelPreset,
) -> NDArray[np.bool_]:
    """Return the masks (n, 480, 640) of counts.

    Args:
        counts: As the device sends them (n, 16, 3) [counts].
        untouched: Without contact (16, 3), or one for each (n, 16, 3) [counts].
        preset: How taxels are numbered.

    Raises:
        ValueError: Another shape, or counts that are not finite.
    """
    change = np.asarray(counts, np.float64) - np.asarray(untouched, np.float64)
    if preset.rows_from_top:
        rows = change.reshape(*change.shape[:-2], _SIDE, _SIDE, 3)
        change = (rows[..., ::-1, :, :] * [1.0, -1.0, 1.0]).reshape(change.shape)
    return draw_discs(change)
