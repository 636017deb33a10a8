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

from sim.fem.columns import Columns
from sim.fem.contact import contact_kernels, face_rule
from sim.fem.element import GAUSS_POINTS, element_kernels
from sim.fem.mesh import Mesh
from sim.fem.nodes import RUN, SUMS, push_kernel, reduce_kernel, residual_kernel
from sim.fem.numerics import Numerics
from sim.fem.scalars import PRECISIONS, matrix_of, numpy_of, vector_of
from sim.fem.state import State
from sim.fem.stencil import Stencil
from sim.fem.sums import Sums
from sim.fem.vectors import fill
from sim.indenters.device import PartTable
from sim.scene import Scene


def _inverses(meshes: Sequence[Mesh]) -> list[np.ndarray]:
    """Inverse Jacobians of each mesh (E, 8, 3, 3); (E, 1, 3, 3) where all elements are boxes.

    Those are alike at all Gauss points, which a mesh tells by repeating them without a copy.
    """
    boxes = all(mesh.inverse.strides[1] == 0 for mesh in meshes)
    return [mesh.inverse[:, :1] if boxes else mesh.inverse for mesh in meshes]


class Assembly:
    """The equations of B presses on meshes of one topology: residual, tangent, preconditioner."""

    def __init__(
        self,
        meshes: Sequence[Mesh],
        scenes: Sequence[Scene],
        numerics: Numerics,
        precision: str,
        device: str,
    ) -> None:
        variants = list({id(mesh): mesh for mesh in meshes}.values())
        places = {id(mesh): place for place, mesh in enumerate(variants)}
        self.meshes = list(meshes)
        """Mesh of each environment (B,)."""
        self.mesh = mesh = variants[0]
        """One of them, for all that they share."""
        self.numerics, self.device = numerics, device
        self.precision = precision
        self.real = real = PRECISIONS[precision]
        self.effects = scenes[0].effects.key
        self.environments = len(scenes)
        vec3, mat33 = vector_of(real), matrix_of(real)
        planted = numerics.planted
        shape, rule = face_rule(numerics.contact_points, nodal=planted.nodal_contact)
        self.points = len(rule)

        self._element = element_kernels(real, "viscosity" in self.effects, planted.full_integration)
        self._residual = residual_kernel(real, "inertia" in self.effects, "gravity" in self.effects)

        self._elements = self._array(mesh.elements, wp.int32)
        self._variant = self._array([places[id(each)] for each in meshes], wp.int32)
        self._inverse = self._array(_inverses(variants), mat33)
        self._weight = self._array([each.weight for each in variants], real)
        self._faces = self._array(mesh.faces, wp.int32)
        self._face_area = self._array([each.face_area for each in variants], real)
        self.face_rule = shape, rule
        """Shape functions of a face's corners at its contact points (P, 4), their weights (P,)."""
        self.shape = self._array(shape, real)
        self.rule = self._array(rule, real)
        self._nodes = self._array([each.nodes for each in variants], vec3)
        self._node_elements = self._array(mesh.node_elements, wp.int32)
        self._node_faces = self._array(mesh.node_faces, wp.int32)
        self._free = self._array(mesh.free, wp.int32)
        self._node_mass = self._array([each.node_volume for each in variants], real)

        bodies = [scene.body for scene in scenes]
        self._shear = self._array([body.shear_modulus / body.modulus for body in bodies], real)
        self._bulk = self._array([body.bulk_modulus / body.modulus for body in bodies], real)
        unit = bodies[0].thickness
        table = PartTable.pack(
            [scene.indenter for scene in scenes], unit=unit, real=real, device=device
        )
        self._table = table.struct
        self._contact = contact_kernels(real, "friction" in self.effects, table.traits)
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
        self._face_energy = wp.zeros((environments, faces), dtype=real, device=device)
        self.touched = wp.zeros((environments, faces), dtype=wp.int32, device=device)
        self._matrix = wp.zeros((environments, faces, self.points), dtype=mat33, device=device)
        self._sums = wp.zeros((environments, self._runs, SUMS), dtype=wp.float64, device=device)
        self._totals = wp.zeros((environments, SUMS), dtype=wp.float64, device=device)
        self._field = wp.zeros((environments, count), dtype=vec3, device=device)
        self.sums = Sums(np.zeros((environments, SUMS)))
        """Sums over the state last evaluated."""
        self.residual = wp.zeros((environments, count), dtype=vec3, device=device)
        """Out-of-balance force of the state last evaluated (B, N) [E T^2]."""
        self.stencil = Stencil(
            mesh,
            real,
            environments,
            device,
            viscous="viscosity" in self.effects,
            full_integration=planted.full_integration,
            # Short steps make inertia stiff without a bound, and float16 has one.
            half=False if "inertia" in self.effects else None,
        )
        """Tangent of the state last linearised."""
        self.columns = Columns(mesh, real, environments, device)
        """Its preconditioner."""
        self.coefficients = [getattr(s.effects.friction, "coefficient", 0.0) for s in scenes]
        self.state = State(self, scenes)
        """What the state of the batch is."""

    def evaluate(self, active, u, direction) -> Sums:
        """Forces at displacement `u` and their sums; `direction` (B, N) is what the slope is of."""
        wp.launch(
            self._element,
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

    def evaluate_contact(self, active, u, direction) -> Sums:
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
                self._variant,
                self._table,
                state.tip,
                self._penalty,
                state.carried,
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
        wp.launch(
            self._residual,
            dim=(self.environments, self._runs),
            inputs=[
                self._node_elements,
                self._node_faces,
                self._free,
                self._node_mass,
                self._variant,
                state.inertia_rate,
                state.predicted,
                state.weight,
                active,
                self._element_force,
                self._element_det,
                self.touched,
                self.face_force,
                u,
                direction,
            ],
            outputs=[self.residual, self._sums],
            device=self.device,
        )
        wp.launch(
            reduce_kernel(),
            dim=(self.environments, SUMS),
            inputs=[active, self._sums],
            outputs=[self._totals],
            device=self.device,
        )
        self.sums = Sums(self._totals.numpy().copy())
        return self.sums

    def push(self, active, travel) -> None:
        """Write the forces of contact that moves by `travel` (B,) into `residual`.

        Contact and its stiffness are those of the state last evaluated: what it would press with
        if the body stood still. Solved for, they say where the body goes with the tip.
        """
        fill(active, travel, self._field)
        self._shove(active, self._field)
        wp.launch(
            push_kernel(self.real),
            dim=(self.environments, len(self.mesh.nodes)),
            inputs=[
                self._node_faces,
                self._free,
                active,
                self.touched,
                self.face_force,
            ],
            outputs=[self.residual],
            device=self.device,
        )

    def _shove(self, active, v) -> None:
        wp.launch(
            self._contact[1],
            dim=(self.environments, len(self.mesh.faces)),
            inputs=[self._faces, self.shape, active, self.touched, self._matrix, v],
            outputs=[self.face_force],
            device=self.device,
        )

    def linearise(self, active, u, damping: np.ndarray, anew=None) -> None:
        """Fill `stencil` and `columns` with the tangent of the state last evaluated, which is `u`.

        `damping` (B,) [E / T^2] stiffens it against any motion, not the residual. The elastic part
        is that of `u` where `anew` (B,) says so, or everywhere; else as it was last.
        """
        self._shift.assign((self.state.rates + damping).astype(numpy_of(self.real)))
        self.stencil.assemble(
            active,
            u,
            (self._inverse, self._weight, self._node_mass, self._variant),
            (self._shear, self._bulk, *self.state.viscous),
            (self.shape, self.touched, self._matrix),
            self._shift,
            anew,
        )
        self.columns.factor(active, self.stencil.matrix)

    def energy(self) -> np.ndarray:
        """Incremental potential of the state last evaluated (B,) [E T^3]; weight left out."""
        elastic = self.element_energy.numpy().sum(axis=1, dtype=float)
        return elastic + self._face_energy.numpy().sum(axis=1, dtype=float)

    def accept(self, chosen: np.ndarray, duration: np.ndarray) -> None:
        """Make the present state of the chosen environments (B,) the start of their next step."""
        self.state.accept(
            chosen,
            duration,
            (self._elements, self._inverse, self._weight, self._variant),
            (self._shear, self._bulk),
        )

    def _element_inputs(self) -> tuple:
        """Mesh and material: the first arguments of both element kernels."""
        geometry = (self._inverse, self._weight, self._variant)
        return (
            self._elements,
            *geometry,
            GAUSS_POINTS,
            self._shear,
            self._bulk,
            *self.state.viscous,
        )

    def _array(self, values, dtype):
        scalar = {wp.int32: np.int32}.get(dtype, numpy_of(self.real))
        return wp.array(
            np.ascontiguousarray(np.asarray(values, dtype=scalar)), dtype=dtype, device=self.device
        )
