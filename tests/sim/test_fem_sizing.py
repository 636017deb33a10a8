from __future__ import annotations

import numpy as np
from scipy import ndimage

from sim.fem.sizing import sizes_of


def test_a_piece_asks_for_the_same_sizes_alone_and_beside_others() -> None:
    random = np.random.default_rng(3)
    for _draw in range(20):
        x, y = (np.cumsum(random.uniform(0.2, 1.0, 50)) for _axis in range(2))
        soft = ndimage.gaussian_filter(random.normal(size=(50, 50)), 3.0)
        touched = soft > np.quantile(soft, 0.8)
        pieces, count = ndimage.label(touched, structure=np.ones((3, 3)))
        assert count > 1
        whole = sizes_of(touched, x, y, 4.0, 0.5)
        alone = [sizes_of(pieces == piece, x, y, 4.0, 0.5) for piece in range(1, count + 1)]
        assert whole.top == min(one.top for one in alone)
        assert whole.width == max(one.width for one in alone)
        spans = {span for one in alone for span in one.x}
        assert set(whole.x) <= spans
        assert min(span.size for span in whole.x) == min(span.size for span in spans)
