"""Finite elements at large strain: the exact tier.

Its settings are here; its solver, which needs Warp, is `sim.fem.solver`.
"""

from __future__ import annotations

from sim.fem.numerics import ELASTIC_EVERY, FOR_EDGES, Grading, Numerics

__all__ = ["ELASTIC_EVERY", "FOR_EDGES", "Grading", "Numerics"]
