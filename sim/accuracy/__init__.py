"""What accuracy costs: error, time and memory of every tier and mesh; docs/accuracy.md."""

from __future__ import annotations

from sim.accuracy.measure import Errors, compare, marker_pixels
from sim.accuracy.outcome import Outcome, outcome_of

__all__ = ["Errors", "Outcome", "compare", "marker_pixels", "outcome_of"]
