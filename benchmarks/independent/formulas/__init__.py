"""Reference solutions of presses, from formulas and integral equations.

They are independent of the rest of the simulator. SI units throughout; a force that presses and a
depth are positive, displacements are in the contact frame (z up, out of the material).
"""

from __future__ import annotations

from benchmarks.independent.formulas.axisymmetric import (
    layer_cone,
    layer_paraboloid,
    layer_punch,
    layer_sphere,
)
from benchmarks.independent.formulas.bonded_layer import (
    edge_decay,
    layer_compliance,
    layer_deficit,
    layer_ratio,
)
from benchmarks.independent.formulas.deep_indentation import NEO_HOOKEAN_SPHERE, DeepIndentation
from benchmarks.independent.formulas.dimitriadis import dimitriadis
from benchmarks.independent.formulas.friction import (
    mindlin_displacement,
    mindlin_force,
    mindlin_loss,
    mindlin_return,
    mindlin_stick_radius,
    mindlin_traction,
)
from benchmarks.independent.formulas.half_space import (
    cone,
    cone_contact_radius,
    flat_punch,
    hertz,
    hertz_contact_radius,
    hertz_displacement,
    hertz_pressure,
    reduced_modulus,
    sphere,
    sphere_contact_radius,
)
from benchmarks.independent.formulas.hayes import (
    HAYES_KAPPA,
    HAYES_POISSON,
    HAYES_PRINTED,
    hayes_kappa,
)
from benchmarks.independent.formulas.homogeneous import (
    confined_stress,
    simple_shear_stress,
    uniaxial_stress,
)
from benchmarks.independent.formulas.layer_contact import LayerContact
from benchmarks.independent.formulas.point_load import boussinesq, cerruti
from benchmarks.independent.formulas.viscoelastic import (
    hereditary,
    lee_radok_punch,
    lee_radok_sphere,
    relaxation_modulus,
)
from benchmarks.independent.formulas.wide_layer import (
    compression_frequency,
    layer_sag,
    oedometric_modulus,
    shear_frequency,
)

__all__ = [
    "HAYES_KAPPA",
    "HAYES_POISSON",
    "HAYES_PRINTED",
    "NEO_HOOKEAN_SPHERE",
    "DeepIndentation",
    "LayerContact",
    "boussinesq",
    "cerruti",
    "compression_frequency",
    "cone",
    "cone_contact_radius",
    "confined_stress",
    "dimitriadis",
    "edge_decay",
    "flat_punch",
    "hayes_kappa",
    "hereditary",
    "hertz",
    "hertz_contact_radius",
    "hertz_displacement",
    "hertz_pressure",
    "layer_compliance",
    "layer_cone",
    "layer_deficit",
    "layer_paraboloid",
    "layer_punch",
    "layer_ratio",
    "layer_sag",
    "layer_sphere",
    "lee_radok_punch",
    "lee_radok_sphere",
    "mindlin_displacement",
    "mindlin_force",
    "mindlin_loss",
    "mindlin_return",
    "mindlin_stick_radius",
    "mindlin_traction",
    "oedometric_modulus",
    "reduced_modulus",
    "relaxation_modulus",
    "shear_frequency",
    "simple_shear_stress",
    "sphere",
    "sphere_contact_radius",
    "uniaxial_stress",
]
