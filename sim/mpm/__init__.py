"""The `mpm` tier: explicit MLS-MPM on a background grid, the paper's own method, well sampled."""

from __future__ import annotations

from sim.mpm.numerics import AUTHORS_CELL, MpmNumerics
from sim.mpm.solver import simulate_mpm

__all__ = ["AUTHORS_CELL", "MpmNumerics", "simulate_mpm"]
