"""Hysteresis of a press: how much force is lost between going down and coming up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from sim.effects import Viscosity
from sim.errors import SceneError

Array = NDArray[np.float64]

# Steps that each way of a press is cut into.
STEPS = 400


def hysteresis(depth: Array, force: Array) -> float:
    """Area between loading and unloading over the area under loading.

    Args:
        depth: Of the tip at each moment (n,) [m], rising to its largest once and falling after it.
        force: Pressing force then (n,) [N].

    Raises:
        SceneError: Depths that do not go down once and up once.
    """
    deepest = int(depth.argmax())
    turns = np.diff(depth)
    if not ((turns[:deepest] > 0).all() and (turns[deepest:] < 0).all() and deepest > 0):
        raise SceneError(f"depth: {depth!r}; allowed: down once, then up once [m]")
    loading = np.trapezoid(force[: deepest + 1], depth[: deepest + 1])
    unloading = -np.trapezoid(force[deepest:], depth[deepest:])
    return float((loading - unloading) / loading)


def relaxed(
    depth: Array, force: Array, viscosity: Viscosity, *, speed: float
) -> tuple[Array, Array]:
    """Depth and force of a press and its way back at `speed` [m/s], from the elastic press alone.

    Force is that of an elastic body plus each branch's, which fades: F(t) = F_e(t) + sum ratio
    int_0^t exp(-(t - s) / time) dF_e(s), and none once the indenter has left the skin (F < 0). It
    is exact for a linear layer whose contact keeps its size (Lee & Radok 1960), as a flat punch's
    does, and to measure what else there is `fit` solves the same press.

    Args:
        depth: Of the elastic press, from 0 to the deepest (n,) [m].
        force: Its pressing force (n,) [N].
        viscosity: The branches.
        speed: Of the tip.
    """
    down = np.linspace(0.0, depth[-1], STEPS + 1)
    way = np.concatenate([down, down[-2::-1]])
    elastic = np.interp(way, depth, force)
    step = depth[-1] / STEPS / speed
    total = elastic.copy()
    for ratio, time in zip(viscosity.ratios, viscosity.times, strict=True):
        fade = np.exp(-step / time)
        held = 0.0
        gain = ratio * time * -np.expm1(-step / time) / step
        for index, change in enumerate(np.diff(elastic), start=1):
            held = fade * held + gain * change
            total[index] += held
    return way, np.maximum(total, 0.0)


def fitted(
    depth: Array, force: Array, times: tuple[float, ...], *, speed: float, share: float
) -> Viscosity:
    """Branches of these times [s], all of one ratio, that lose `share` of a press's area.

    Raises:
        SceneError: No ratio up to 10 loses as much.
    """

    def with_ratio(ratio: float) -> Viscosity:
        return Viscosity(ratios=(ratio,) * len(times), times=times)

    def excess(ratio: float) -> float:
        return hysteresis(*relaxed(depth, force, with_ratio(ratio), speed=speed)) - share

    if not excess(0.0) < 0 < excess(10.0):
        raise SceneError(
            f"share: {share!r}; allowed with times {times!r} s at {speed:g} m/s: above 0, below "
            f"{excess(10.0) + share:.3f}"
        )
    return with_ratio(float(brentq(excess, 0.0, 10.0, xtol=1e-6)))
