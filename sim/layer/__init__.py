"""The `layer` tier: a linear elastic layer bonded to a rigid base, solved by convolution."""

from __future__ import annotations

from sim.layer.solver import Press, simulate_layer
from sim.layer.spectral import Grid

__all__ = ["Grid", "Press", "simulate_layer"]
