"""Witnesses of directions: the tip's way and place, as pictures, taxels and a gauge show them.

A session's `expected` states how its bench mounts them: the turn of the picture, the places of
taxels. Without it, or without a shear, they are not verified. Vectors are complex numbers, with y
as the imaginary part.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.checks.testimony import Testimony
from recorder.findings import Finding
from recorder.session.columns import Stream
from recorder.session.presses import ASIDE, BACK, DOWN, Presses

# How well vectors must follow ways, turned (1: exactly); and how far these must spread to tell a
# mirrored axis from a turned one.
FOLLOWS, SPREAD = 0.5, 0.15
# Largest angle between the motion of a signal and that of the tip [deg]: half of the least by which
# a mount is wrong. Least way aside that is a shear [m], and motion of the signal in it, over that
# from one sample to the next at rest.
ASTRAY, ASIDE_WAY, MOVES = 45.0, 1e-4, 10.0
# Least change of taxels by a press, over that from one sample to the next; and distance from the
# tip at which they show it, over that of two taxels.
TOUCHED, BESIDE = 50.0, 0.85


def follows(ways: Any, seen: Any, astray: float) -> tuple[float, str]:
    """Return how doubtful it is that vectors (n,) follow the ways (n,), and how they do.

    The angle between them may be up to `astray` [deg].
    """
    way, size = np.asarray(ways), max(float(np.abs(ways) @ np.abs(seen)), 1e-30)
    turned, mirrored = (way.conj() @ seen) / size, (way @ seen) / size
    angle = float(np.degrees(np.angle(turned)))
    doubt = max((1 - abs(turned)) / (1 - FOLLOWS), abs(angle) / astray)
    # Ways along one line cannot tell a mirrored axis from a turned one.
    if abs(mirrored) > abs(turned) and 1 - abs((way**2).sum()) / (np.abs(way) ** 2).sum() > SPREAD:
        return float(doubt), "mirrored: an axis is swapped or has a wrong sign"
    if abs(turned) > FOLLOWS:
        return float(doubt), f"turned by {angle:+.0f} degrees: check the axes"
    return float(doubt), "without relation to it"


def sheared(presses: Presses, stream: Stream, flow: NDArray[Any]) -> Iterator[Testimony]:
    """Signals that move otherwise than the tip in a shear: by `flow` from one row to the next."""
    ways, seen, rest = [], [], float(np.quantile(np.abs(flow), 0.2))
    for one in presses.phases:
        if one.code in (ASIDE, BACK) and one.whole and abs(one.way) > ASIDE_WAY:
            rows = presses.rows(stream, one.run, one.start, one.end)
            moved = complex(flow[rows.start : rows.stop].sum())
            if abs(moved) > MOVES * rest:
                ways.append(one.way / abs(one.way))
                seen.append(moved / abs(moved))
    turned, where = presses.session.setting("expected").get("turned"), f"streams/{stream.name}"
    if turned is None or not ways:
        why = "no shear shows it" if turned is not None else "the bench does not state it"
        yield Testimony(0.0, Finding("unverified", where, f"orientation not verified: {why}"))
        return
    doubt, how = follows(np.array(ways) * np.exp(1j * turned), seen, ASTRAY)
    message = f"the motion in {len(ways)} shears is, beside the tip's, {how}"
    yield Testimony(doubt, Finding("turned", where, message))


def taxel_order(presses: Presses, stream: Stream, values: NDArray[Any]) -> Iterator[Testimony]:
    """Taxels (rows, n, 3) in another order, or with another z, than the tip's place tells."""
    at = np.array(presses.session.setting("expected").get("taxels") or (), float)
    noise, where = float(np.median(np.abs(np.diff(values, axis=0)))), f"streams/{stream.name}"
    outward, sides, down, beside = [], [], [], []
    for one in presses.phases:
        rows = presses.rows(stream, one.run, one.start, one.end)
        if one.code != DOWN or not one.whole or len(rows) < 6 or len(at) != values.shape[1]:
            continue
        change = values[rows[-3] : rows.stop].mean(axis=0) - values[rows[0] : rows[3]].mean(axis=0)
        size = float(np.abs(change).max())
        if size > TOUCHED * noise and len(one.place):
            below = np.maximum(change[:, 2], 0.0)
            middle = below @ at / max(below.sum(), 1e-9)
            beside.append(float(np.linalg.norm(middle - one.place[-1, :2])))
            outward += ((at - one.place[-1, :2]) @ (1, 1j)).tolist()
            sides += (change[:, :2] @ (1, 1j) / size).tolist()
            down.append(float(change[np.abs(change).max(axis=1).argmax(), 2]) / size)
    if down:
        # A press moves the skin outwards about the tip, and down most below it.
        doubt, how = follows(outward, sides, ASTRAY)
        yield Testimony(doubt, Finding("turned", where, f"sides of a press are {how}"))
        apart, least = float(np.median(beside)), min(down)
        message = f"a press shows {1e3 * apart:.3g} mm beside the tip: check the taxels' order"
        doubt = apart / (BESIDE * float(np.linalg.norm(at[1:] - at[0], axis=1).min()))
        yield Testimony(doubt, Finding("turned", where, message))
        message = f"below a press, z has {least:+.2f} of the largest change: check the axes"
        yield Testimony((1 - least) / (1 - FOLLOWS), Finding("wrong-sign", where, message))
