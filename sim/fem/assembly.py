# mypy: ignore-errors
# Warp's arrays and kernels are typed at run time; mypy cannot follow them.
"""Everything on the device for one batch: mesh, material, state; and the forces that follow.

Units: lengths in thicknesses T, stresses in moduli E, forces in E T^2, times in seconds. So the
arithmetic is the same whatever units or stiffness a scene has.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from sim.fem.contact import contact_kernels, face_rule
from sim.fem.element import GAUSS_POINTS, element_kernels
from sim.fem.mesh import Mesh
from sim.fem.nodes import (
    RUN,
    jacobi_kernel,
    reduce_kernel,
    residual_kernel,
    tangent_kernel,
)
from sim.fem.numerics import Numerics
from sim.fem.rest_blocks import rest_blocks
from sim.fem.scalars import PRECISIONS, matrix_of, numpy_of, vector_of
from sim.fem.state import State
from sim.indenters.device import PartTable
from sim.scene import Scene


class Assembly:
    """The equations of B presses on one mesh: residual, tangent, preconditioner."""

    def __init__(
        self, mesh: Mesh, scenes: Sequence[Scene], numerics: Numerics, precision: str, device: str
    ) -> None:
        self.mesh, self.numerics, self.device = mesh, numerics, device
        self.precision = precision
        self.real = real = PRECISIONS[precision]
        self.effects = scenes[0].effects.key
        self.environments = len(scenes)
        vec3, mat33 = vector_of(real), matrix_of(real)
        planted = numerics.planted
        shape, rule = face_rule(numerics.contact_points, nodal=planted.nodal_contact)
        self.points = len(rule)

        self._element = element_kernels(real, "viscosity" in self.effects, planted.full_integration)
        self._contact = contact_kernels(real, "friction" in self.effects)
        self._residual = residual_kernel(real, "inertia" in self.effects, "gravity" in self.effects)

        self._elements = self._array(mesh.elements, wp.int32)
        self._inverse = self._array(mesh.inverse, mat33)
        self._weight = self._array(mesh.weight, real)
        self._faces = self._array(mesh.faces, wp.int32)
        self._face_area = self._array(mesh.face_area, real)
        self.shape = self._array(shape, real)
        self.rule = self._array(rule, real)
        self._nodes = self._array(mesh.nodes, vec3)
        self._node_elements = self._array(mesh.node_elements, wp.int32)
        self._node_faces = self._array(mesh.node_faces, wp.int32)
        self._free = self._array(mesh.free, wp.int32)
        self._all_free = self._array(np.ones(len(mesh.nodes)), wp.int32)
        self._node_mass = self._array(mesh.node_volume, real)
        shear_block, bulk_block = rest_blocks(mesh)
        self._shear_block = self._array(shear_block, mat33)
        self._bulk_block = self._array(bulk_block, mat33)

        bodies = [scene.body for scene in scenes]
        self._shear = self._array([body.shear_modulus / body.modulus for body in bodies], real)
        self._bulk = self._array([body.bulk_modulus / body.modulus for body in bodies], real)
        unit = bodies[0].thickness
        self._table = PartTable.pack(
            [scene.indenter for scene in scenes], unit=unit, real=real, device=device
        ).struct
        self._penalty = real(numerics.penalty)
        self._stick = real(numerics.stick)

        environments, count = self.environments, len(mesh.nodes)
        elements, faces = len(mesh.elements), len(mesh.faces)
        self._runs = -(-count // RUN)
        self._shift = wp.zeros(environments, dtype=real, device=device)
        self._element_force = wp.zeros((environments, elements, 8), dtype=vec3, device=device)
        self.element_energy = wp.zeros((environments, elements), dtype=real, device=device)
        self._element_det = wp.zeros((environments, elements), dtype=real, device=device)
        self.face_force = wp.zeros((environments, faces, 4), dtype=vec3, device=device)
        self._face_block = wp.zeros((environments, faces, 4), dtype=mat33, device=device)
        self._face_energy = wp.zeros((environments, faces), dtype=real, device=device)
        self.touched = wp.zeros((environments, faces), dtype=wp.int32, device=device)
        self._matrix = wp.zeros((environments, faces, self.points), dtype=mat33, device=device)
        self._sums = wp.zeros((environments, self._runs, 3), dtype=wp.float64, device=device)
        self._totals = wp.zeros((environments, 3), dtype=wp.float64, device=device)
        self.residual = wp.zeros((environments, count), dtype=vec3, device=device)
        """Out-of-balance force of the state last evaluated (B, N) [E T^2]."""
        self.jacobi = wp.zeros((environments, count), dtype=mat33, device=device)
        """Inverse diagonal blocks of the state last linearised (B, N)."""
        self.coefficients = [getattr(s.effects.friction, "coefficient", 0.0) for s in scenes]
        self.state = State(self, scenes)
        """What the state of the batch is."""

    def evaluate(self, active, u, direction) -> np.ndarray:
        """Forces at displacement `u`; |r|^2, |applied|^2 and -r.direction by environment (B, 3)."""
        wp.launch(
            self._element[0],
            dim=(self.environments, len(self.mesh.elements)),
            inputs=[
                *self._element_inputs(),
                active,
                u,
            ],
            outputs=[self._element_force, self.element_energy, self._element_det],
            device=self.device,
        )
        return self.evaluate_contact(active, u, direction)

    def evaluate_contact(self, active, u, direction) -> np.ndarray:
        """As `evaluate`, where only the friction limit changed since the last one."""
        state = self.state
        wp.launch(
            self._contact[0],
            dim=(self.environments, len(self.mesh.faces)),
            inputs=[
                self._faces,
                self._face_area,
                self.shape,
                self.rule,
                self._nodes,
                self._table,
                state.tip,
                self._penalty,
                *state.friction(self._stick),
                active,
                u,
            ],
            outputs=[
                self.face_force,
                self.touched,
                state.pressure,
                state.normal,
                state.traction,
                self._matrix,
                self._face_energy,
            ],
            device=self.device,
        )
        return self._gather(active, u, direction, self._free, self.residual)

    def _gather(self, active, u, direction, free, residual) -> np.ndarray:
        state = self.state
        wp.launch(
            self._residual,
            dim=(self.environments, self._runs),
            inputs=[
                self._node_elements,
                self._node_faces,
                free,
                self._node_mass,
                state.inertia_rate,
                state.predicted,
                state.weight,
                active,
                self._element_force,
                self.touched,
                self.face_force,
                u,
                direction,
            ],
            outputs=[residual, self._sums],
            device=self.device,
        )
        wp.launch(
            reduce_kernel(),
            dim=(self.environments, 3),
            inputs=[active, self._sums],
            outputs=[self._totals],
            device=self.device,
        )
        return self._totals.numpy().copy()

    def linearise(self, active, damping: np.ndarray) -> None:
        """Fill `jacobi` for the state last evaluated.

        `damping` (B,) [E / T^2] stiffens the tangent against any motion, not the residual.
        """
        self._shift.assign((self.state.rates + damping).astype(numpy_of(self.real)))
        wp.launch(
            self._contact[2],
            dim=(self.environments, len(self.mesh.faces)),
            inputs=[self.shape, active, self.touched, self._matrix],
            outputs=[self._face_block],
            device=self.device,
        )
        factor, bulk_factor = self.state.viscous[:2]
        wp.launch(
            jacobi_kernel(self.real),
            dim=(self.environments, len(self.mesh.nodes)),
            inputs=[
                self._node_faces,
                self._free,
                self._node_mass,
                self._shear_block,
                self._bulk_block,
                self._shear,
                self._bulk,
                factor,
                bulk_factor,
                self._shift,
                active,
                self.touched,
                self._face_block,
            ],
            outputs=[self.jacobi],
            device=self.device,
        )

    def tangent(self, u):
        """The derivative at `u` as a function for `ConjugateGradient.solve`."""

        def apply(active, v, product, sums) -> None:
            wp.launch(
                self._element[1],
                dim=(self.environments, len(self.mesh.elements)),
                inputs=[
                    *self._element_inputs(),
                    active,
                    u,
                    v,
                ],
                outputs=[self._element_force],
                device=self.device,
            )
            wp.launch(
                self._contact[1],
                dim=(self.environments, len(self.mesh.faces)),
                inputs=[self._faces, self.shape, active, self.touched, self._matrix, v],
                outputs=[self.face_force],
                device=self.device,
            )
            wp.launch(
                tangent_kernel(self.real),
                dim=(self.environments, self._runs),
                inputs=[
                    self._node_elements,
                    self._node_faces,
                    self._free,
                    self._node_mass,
                    self._shift,
                    active,
                    self._element_force,
                    self.touched,
                    self.face_force,
                    v,
                ],
                outputs=[product, sums],
                device=self.device,
            )

        return apply

    def det_min(self) -> np.ndarray:
        """Smallest det F of the state last evaluated (B,)."""
        return self._element_det.numpy().min(axis=1).astype(float)

    def energy(self) -> np.ndarray:
        """Incremental potential of the state last evaluated (B,) [E T^3]; weight left out."""
        elastic = self.element_energy.numpy().sum(axis=1, dtype=float)
        return elastic + self._face_energy.numpy().sum(axis=1, dtype=float)

    def accept(self, active, duration: np.ndarray) -> None:
        """Make the present state of `active` environments the start of their next step."""
        self.state.accept(
            active,
            duration,
            (self._elements, self._inverse, self._weight),
            (self._shear, self._bulk),
        )

    def contact_force(self) -> np.ndarray:
        """Force of the indenter on each body, state last evaluated (B, 3) [E T^2]."""
        force = self.face_force.numpy().sum(axis=2, dtype=float)
        return np.where(self.touched.numpy()[:, :, None] > 0, force, 0.0).sum(axis=1)

    def reactions(self) -> np.ndarray:
        """Force of the base on each body (B, 3) [E T^2], from the elements on it.

        Evaluates the present state once more, everywhere: what was last evaluated is that state.
        """
        everyone, u = self.state.everyone, self.state.u
        nothing = wp.zeros_like(self.residual)
        self.evaluate(everyone, u, nothing)
        held = wp.zeros_like(self.residual)
        self._gather(everyone, u, nothing, self._all_free, held)
        base = held.numpy()[:, self.mesh.base].sum(axis=1, dtype=float)
        return -base

    def _element_inputs(self) -> tuple:
        """Mesh and material: the first arguments of both element kernels."""
        mesh = (self._elements, self._inverse, self._weight, GAUSS_POINTS)
        return (*mesh, self._shear, self._bulk, *self.state.viscous)

    def _array(self, values, dtype):
        scalar = {wp.int32: np.int32}.get(dtype, numpy_of(self.real))
        return wp.array(
            np.ascontiguousarray(np.asarray(values, dtype=scalar)), dtype=dtype, device=self.device
        )
