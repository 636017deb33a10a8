"""The `layer` tier: a linear elastic layer bonded to a rigid base, solved by convolution.

The settings are in this package; the solver is in `sim.layer.solver`.
"""

from __future__ import annotations

from sim.layer.numerics import Layer

__all__ = ["Layer"]
