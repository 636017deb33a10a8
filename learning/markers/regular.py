"""Regularity of the patches in a mask: markers are alike and evenly spaced, shading is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from recorder.markers import Blobs

# Fewest markers, and largest relative spread of their areas and of the distances to the nearest
# one (half of the range from 16 to 84 %, over the median), that count as a pattern. Patterns of the
# paper have up to 0.2 and 0.25; shading and dust have 0.5 and more in one of both.
MARKERS_LEAST, SPREAD_MOST = 9, 0.45
# Distance up to which patches are neighbours [pitches], and fewest neighbours within a pattern: a
# corner of a square pattern has three.
NEIGHBOURS_WITHIN, NEIGHBOURS_LEAST = 1.75, 3


@dataclass(frozen=True, slots=True)
class Spread:
    """Number of the patches of a mask, and their spread."""

    count: int
    area: float
    """Spread of the areas, over the median."""
    pitch: float
    """Spread of the distances to the nearest patch, over the median."""

    @property
    def is_regular(self) -> bool:
        """True if there are enough patches, alike and evenly spaced."""
        return (
            self.count >= MARKERS_LEAST and self.area <= SPREAD_MOST and self.pitch <= SPREAD_MOST
        )

    def __str__(self) -> str:
        return (
            f"{self.count} patches whose areas spread {100 * self.area:.0f} % and whose distances "
            f"spread {100 * self.pitch:.0f} %; markers are {MARKERS_LEAST} or more, within "
            f"{100 * SPREAD_MOST:.0f} %"
        )


def spread_of(blobs: Blobs) -> Spread:
    """Return number and spread of the patches of one mask."""
    if len(blobs) < 2:
        return Spread(len(blobs), 0.0, 0.0)
    return Spread(len(blobs), _spread(blobs.area), _spread(pitch_of(blobs)))


def pitch_of(blobs: Blobs) -> NDArray[np.float64]:
    """Return the distance of each of two or more patches to the nearest other (m,) [px]."""
    return np.asarray(cKDTree(blobs.centre).query(blobs.centre, 2)[0][:, 1])


def in_pattern(blobs: Blobs, pitch_px: float) -> NDArray[np.bool_]:
    """Return which patches (m,) belong to the largest group of close neighbours, or touch it.

    Reflections and dust beside the skin are few or in a line, and belong to none.
    """
    reach = NEIGHBOURS_WITHIN * pitch_px
    pairs = cKDTree(blobs.centre).query_pairs(reach, output_type="ndarray")
    inner = np.bincount(pairs.ravel(), minlength=len(blobs)) >= NEIGHBOURS_LEAST
    if not inner.any():
        return np.ones(len(blobs), bool)
    among = pairs[inner[pairs].all(axis=1)]
    graph = coo_matrix((np.ones(len(among)), among.T), (len(blobs), len(blobs)))
    group = np.where(inner, connected_components(graph, directed=False)[1], -1)
    own = group == np.bincount(group[inner]).argmax()
    near = pairs[own[pairs].any(axis=1)]
    own[near.ravel()] = True
    return np.asarray(own)


def _spread(values: ArrayLike) -> float:
    low, middle, high = np.percentile(np.asarray(values, np.float64), [16, 50, 84])
    return float((high - low) / 2 / middle)
