"""Hysteresis of a press: loss of force between loading and unloading."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from sim.errors import SceneError
from sim.scene import Viscosity

Array = NDArray[np.float64]

# Number of steps of loading and of unloading.
STEPS = 400


def hysteresis(depth: Array, force: Array) -> float:
    """Return the area between loading and unloading over the area under loading.

    Args:
        depth: Depths of the tip (n,) [m], rising once to the largest and then decreasing.
        force: Pressing forces (n,) [N].

    Raises:
        SceneError: Depths that do not increase once and then decrease once.
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
    """Return depth and force of loading and unloading at `speed` [m/s], from an elastic press.

    Force is that of an elastic body plus the decaying force of each branch: F(t) = F_e(t) + sum
    ratio int_0^t exp(-(t - s) / time) dF_e(s), and 0 once the indenter has left the skin (F < 0).
    This is exact for a linear layer with constant contact area (Lee & Radok 1960), as under a flat
    punch; for other indenters `fit` solves the same press to measure the difference.

    Args:
        depth: Depths of the elastic press, from 0 to the deepest (n,) [m].
        force: Pressing forces (n,) [N].
        viscosity: Prony branches.
        speed: Speed of the tip.
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
    depth: Array, force: Array, times: tuple[float, ...], *, speed: float, fraction: float
) -> Viscosity:
    """Return branches of these times [s] with equal ratios that lose `fraction` of a press's area.

    Raises:
        SceneError: No ratio up to 10 loses as much.
    """

    def with_ratio(ratio: float) -> Viscosity:
        return Viscosity(ratios=(ratio,) * len(times), times=times)

    def excess(ratio: float) -> float:
        return hysteresis(*relaxed(depth, force, with_ratio(ratio), speed=speed)) - fraction

    if not excess(0.0) < 0 < excess(10.0):
        raise SceneError(
            f"fraction: {fraction!r}; allowed with times {times!r} s at {speed:g} m/s: above 0, "
            "below "
            f"{excess(10.0) + fraction:.3f}"
        )
    return with_ratio(float(brentq(excess, 0.0, 10.0, xtol=1e-6)))
