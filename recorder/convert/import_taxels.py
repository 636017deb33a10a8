"""Taxel counts from an .npy file, rounded to the integers that the device transmits."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_answers import ORDERS, TaxelOrder
from recorder.convert.import_tracks import Numbers, rate_of
from recorder.errors import SessionError

_COUNT_MAX = 0xFFFF

# Shapes that state an order by themselves.
_SHAPES: dict[tuple[int, ...], TaxelOrder] = {(16, 3): "taxel", (3, 16): "axis"}
# Spread of the resting counts within an axis in the wrong order, over that in the right order, from
# which the order counts as known. In three logs of a uSkin it is 9.6 (x and y rest near 33,000
# counts, z near 20,000 or 45,000); without such a difference between the axes it is about 1.
_TOLD_APART = 2.5
# Spread below which counts say nothing: a tared log has only noise [counts].
_SPREAD_LEAST = 100.0
# Rows of which the stillest ones in a row serve as the resting counts.
_RESTING_ROWS = 10


def is_taxels(shape: tuple[int, ...]) -> bool:
    """Return True if an array of that shape holds the counts of 16 taxels, row by row."""
    return shape[1:] in ((48,), *_SHAPES)


def counts_of(
    name: str, array: NDArray[Any], t_ns: NDArray[np.int64], order: TaxelOrder | None = None
) -> Numbers:
    """Return counts (n, 48), (n, 16, 3) or (n, 3, 16) taken at times (n,) [ns].

    Args:
        name: Name of the file, for messages.
        array: The counts.
        t_ns: Time of each row.
        order: Order of the numbers in a row. None: by the resting counts, which differ more between
            the axes of a uSkin than between its taxels.
    """
    if not is_taxels(array.shape) or not len(array):
        raise SessionError(
            f"{name}: found shape {array.shape}; allowed: (n, 48), (n, 16, 3), (n, 3, 16)"
        )
    values = array.reshape(len(array), 48).astype(np.float64)
    whole = np.rint(values)
    bad = np.flatnonzero(~((whole >= 0) & (whole <= _COUNT_MAX)).all(axis=1))
    if bad.size:
        row = values[bad[0]]
        worst = row[~((np.rint(row) >= 0) & (np.rint(row) <= _COUNT_MAX))][0]
        raise SessionError(
            f"{name}: row {bad[0]}: found {worst:g}; allowed: 0 to {_COUNT_MAX} counts "
            f"({bad.size} such rows)"
        )
    assumed = []
    largest = float(np.abs(values - whole).max())
    if largest > 0:
        assumed.append(
            f"{name}: rounded to whole counts, as the device sends them; largest change "
            f"{largest:.3g} counts"
        )
    if order is None:
        order, why = _order_of(name, whole, _SHAPES.get(array.shape[1:]))
        assumed.append(why)
    return Numbers(in_order(whole, order).astype(np.int32), t_ns, rate_of(t_ns), assumed)


def in_order(rows: NDArray[np.float64], order: TaxelOrder) -> NDArray[np.float64]:
    """Return rows (n, 3 m) of m taxels as (n, m, 3)."""
    count = rows.shape[1] // 3
    if order == "taxel":
        return rows.reshape(-1, count, 3)
    return rows.reshape(-1, 3, count).transpose(0, 2, 1)


def told_order(rows: NDArray[np.float64]) -> tuple[TaxelOrder | None, str]:
    """Return the order of rows (n, 3 m), None if it cannot be told, and the counts that tell it.

    A uSkin's taxels rest at similar counts along an axis, and far apart along different axes.
    """
    resting = _resting(rows)
    spread = {one: float(in_order(resting, one)[0].std(axis=0).mean()) for one in ORDERS}
    found = min(ORDERS, key=lambda one: spread[one])
    within, across = spread[found], max(spread.values())
    counts = f"resting counts spread {within:.0f} within an axis, {across:.0f} in the other order"
    return (found if across >= _TOLD_APART * max(within, _SPREAD_LEAST) else None), counts


def _order_of(
    name: str, rows: NDArray[np.float64], by_shape: TaxelOrder | None
) -> tuple[TaxelOrder, str]:
    """Return the order of rows (n, 48), and a message on how it is known."""
    found, counts = told_order(rows)
    if found is None:
        if by_shape is not None:
            return by_shape, f"{name}: order '{by_shape}' by its shape"
        raise SessionError(
            f"{name}: cannot tell the order of its 48 columns ({counts}); say --taxel-order taxel "
            "(x y z of each taxel) or --taxel-order axis (x of all taxels, then y, then z)"
        )
    if by_shape not in (None, found):
        raise SessionError(
            f"{name}: its shape says order '{by_shape}', its values '{found}' ({counts}); say "
            "--taxel-order taxel or --taxel-order axis"
        )
    return found, f"{name}: order '{found}' ({counts})"


def _resting(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean of the stillest rows in a row, as (1, 3 m)."""
    count = min(_RESTING_ROWS, len(rows))
    begin = np.zeros((1, rows.shape[1]))
    totals = np.cumsum(np.concatenate([begin, rows]), axis=0)
    squares = np.cumsum(np.concatenate([begin, rows**2]), axis=0)
    mean = (totals[count:] - totals[:-count]) / count
    variance = (squares[count:] - squares[:-count]) / count - mean**2
    stillest = int(np.argmin(variance.sum(axis=1)))
    return np.asarray(mean[stillest : stillest + 1])
