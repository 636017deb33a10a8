"""Closed forms and integral equations of presses, which share no code with the simulator.

SI units; a force that presses and a depth are positive, displacements are in the contact frame (z
up, out of the material).
"""

from __future__ import annotations

from benchmarks.independent.formulas.friction import (
    mindlin_displacement,
    mindlin_stick_radius,
)
from benchmarks.independent.formulas.half_space import (
    boussinesq,
    cerruti,
    cone,
    flat_punch,
    hertz,
    hertz_contact_radius,
    reduced_modulus,
)
from benchmarks.independent.formulas.in_time import (
    compression_frequency,
    hereditary,
    layer_sag,
    oedometric_modulus,
)
from benchmarks.independent.formulas.layer import layer_compliance, layer_deficit, layer_ratio
from benchmarks.independent.formulas.layer_contact import (
    LayerContact,
    LinearLayer,
    layer_punch,
    layer_sphere,
)
from benchmarks.independent.formulas.solid import (
    confined_stress,
    simple_shear_stress,
    uniaxial_stress,
)

__all__ = [
    "LayerContact",
    "LinearLayer",
    "boussinesq",
    "cerruti",
    "compression_frequency",
    "cone",
    "confined_stress",
    "flat_punch",
    "hereditary",
    "hertz",
    "hertz_contact_radius",
    "layer_compliance",
    "layer_deficit",
    "layer_punch",
    "layer_ratio",
    "layer_sag",
    "layer_sphere",
    "mindlin_displacement",
    "mindlin_stick_radius",
    "oedometric_modulus",
    "reduced_modulus",
    "simple_shear_stress",
    "uniaxial_stress",
]
