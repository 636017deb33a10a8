"""The `mpm` tier: explicit MLS-MPM on a background grid, the paper's own method, well sampled.

The settings are in this package; the solver, which needs Warp, is in `sim.mpm.solver`.
"""

from __future__ import annotations

from sim.mpm.numerics import AUTHORS_CELL, Mpm

__all__ = ["AUTHORS_CELL", "Mpm"]
