"""The `layer` tier: a linear elastic layer bonded to a rigid base, solved by convolution."""

from __future__ import annotations

from sim.layer.contact import Clearance
from sim.layer.solver import GRID, TOLERANCE, History, LayerPress, check_known, simulate_layer
from sim.layer.spectral import Grid

__all__ = [
    "GRID",
    "TOLERANCE",
    "Clearance",
    "Grid",
    "History",
    "LayerPress",
    "check_known",
    "simulate_layer",
]
