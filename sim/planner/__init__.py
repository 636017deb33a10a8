"""Buying just the accuracy that is needed: the cheapest choice within a tolerance."""

from __future__ import annotations

from sim.planner.choices import Choice
from sim.planner.plan import Offer, Plan, plan
from sim.planner.run import simulate_within, with_error_bar
from sim.planner.tolerance import Tolerance, tolerance_of

__all__ = [
    "Choice",
    "Offer",
    "Plan",
    "Tolerance",
    "plan",
    "simulate_within",
    "tolerance_of",
    "with_error_bar",
]
