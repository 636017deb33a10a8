"""Buying just the accuracy that is needed: the cheapest choice within a tolerance."""

from __future__ import annotations

from sim.planner.error_model import BAR_FLOOR, FEW, PROMISED, CostRow, Model, Table, fit
from sim.planner.features import (
    GROUPS,
    KINDS,
    LADDER,
    WHAT,
    Choice,
    Features,
    Kind,
    Probe,
    Tolerance,
    companion,
    probe,
    tolerance_of,
)
from sim.planner.plan import (
    Offer,
    Plan,
    conditions_text,
    plan,
    simulate_within,
    stored,
    with_error_bar,
)
from sim.planner.seconds import SecondsModel, Timed, device_kind

__all__ = [
    "BAR_FLOOR",
    "FEW",
    "GROUPS",
    "KINDS",
    "LADDER",
    "PROMISED",
    "WHAT",
    "Choice",
    "CostRow",
    "Features",
    "Kind",
    "Model",
    "Offer",
    "Plan",
    "Probe",
    "SecondsModel",
    "Table",
    "Timed",
    "Tolerance",
    "companion",
    "conditions_text",
    "device_kind",
    "fit",
    "plan",
    "probe",
    "simulate_within",
    "stored",
    "tolerance_of",
    "with_error_bar",
]
