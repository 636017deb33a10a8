"""Error, time and memory of every tier and mesh; writes docs/results/accuracy.md."""

from __future__ import annotations

from sim.metrics import Errors, Outcome, compare, marker_pixels, outcome_of

__all__ = ["Errors", "Outcome", "compare", "marker_pixels", "outcome_of"]
