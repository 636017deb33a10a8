"""The `mpm` tier: explicit MLS-MPM on a background grid, the paper's own method, well sampled."""

from __future__ import annotations

from sim.mpm.numerics import MpmNumerics
from sim.mpm.solver import simulate_mpm

__all__ = ["MpmNumerics", "simulate_mpm"]
