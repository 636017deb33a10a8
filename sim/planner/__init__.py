"""Buying just the accuracy that is needed: the cheapest choice within a tolerance."""

from __future__ import annotations

from sim.planner.features import Choice, Tolerance, tolerance_of
from sim.planner.plan import Offer, Plan, plan, simulate_within, with_error_bar

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
