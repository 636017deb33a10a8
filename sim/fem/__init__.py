"""Finite elements at large strain: the most accurate tier.

The settings are in this package; the solver, which needs Warp, is in `sim.fem.solver`.
"""

from __future__ import annotations

from sim.fem.numerics import FOR_EDGES, Fem, Grading

__all__ = ["FOR_EDGES", "Fem", "Grading"]
