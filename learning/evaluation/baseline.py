"""Ridge regression on 11 features of the change of colours: what a network must at least reach."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.archive import SHADING_ZERO

Floats = NDArray[np.float64]

# Names of the features of a frame: by colour the mean, the mean size and the spread of the change;
# the part of the view that changed by more than `_CHANGED`, and the largest change but for 1 %.
FEATURES = (
    *(f"mean {colour}" for colour in ("red", "green", "blue")),
    *(f"mean size {colour}" for colour in ("red", "green", "blue")),
    *(f"spread {colour}" for colour in ("red", "green", "blue")),
    "part changed",
    "99th percentile",
)
# Change from which a pixel counts as changed, mean of the colours [grey levels].
_CHANGED = 8.0
# Penalties that are tried.
_PENALTIES = (0.1, 1.0, 10.0, 100.0)


def colour_features(shading: NDArray[np.uint8]) -> Floats:
    """Return the features (n, 11) of shading frames (n, 3, h, w)."""
    features = np.empty((len(shading), len(FEATURES)))
    for row, frame in enumerate(shading):
        change = frame.reshape(3, -1).astype(np.float64) - SHADING_ZERO
        size = np.abs(change)
        mean = size.mean(axis=0)
        features[row] = [
            *change.mean(axis=1),
            *size.mean(axis=1),
            *change.std(axis=1),
            (mean > _CHANGED).mean(),
            np.percentile(mean, 99),
        ]
    return features


@dataclass(frozen=True, slots=True, eq=False)
class Ridge:
    """Linear predictor of one number from standardised features."""

    centre: Floats
    scale: Floats
    weights: Floats
    offset: float
    penalty: float

    def predict(self, features: Floats) -> Floats:
        """Return the predictions (n,) of features (n, m)."""
        return np.asarray((features - self.centre) / self.scale @ self.weights + self.offset)


def fit_ridge(features: Floats, wanted: Floats, groups: Sequence[int]) -> Ridge:
    """Return the ridge regression whose penalty predicts groups that were left out best.

    Of features (n, m) without NaN; rows whose number to predict (n,) is NaN are left out. A group
    is for instance a press.
    """
    labelled = np.isfinite(wanted)
    rows, numbers, of = features[labelled], wanted[labelled], np.asarray(groups)[labelled]
    off = np.zeros(len(_PENALTIES))
    for group in np.unique(of):
        inside = of == group
        if inside.all():
            continue
        for index, penalty in enumerate(_PENALTIES):
            fitted = _fit(rows[~inside], numbers[~inside], penalty)
            off[index] += float(((fitted.predict(rows[inside]) - numbers[inside]) ** 2).sum())
    return _fit(rows, numbers, _PENALTIES[int(np.argmin(off))])


def _fit(features: Floats, wanted: Floats, penalty: float) -> Ridge:
    centre, scale = features.mean(axis=0), features.std(axis=0)
    scale = np.where(scale > 0, scale, 1.0)
    rows = (features - centre) / scale
    offset = float(wanted.mean())
    square = rows.T @ rows + penalty * np.eye(rows.shape[1])
    weights = np.linalg.solve(square, rows.T @ (wanted - offset))
    return Ridge(centre, scale, np.asarray(weights), offset, penalty)
