"""The `layer` tier: a linear elastic layer bonded to a rigid base, solved by convolution."""

from __future__ import annotations

from sim.layer.grid import Grid
from sim.layer.press import Press
from sim.layer.solver import simulate_layer

__all__ = ["Grid", "Press", "simulate_layer"]
