# mypy: ignore-errors
# Warp's arrays and kernels are typed at run time; mypy cannot follow them.
"""The state of a batch: where everything is, and what the effects that are on remember.

An effect that is off has arrays of length zero: no memory, no work.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from sim.fem.scalars import matrix_of, numpy_of, vector_of
from sim.fem.vectors import blend, copy_active, extrapolate
from sim.fem.viscous import Branches

if TYPE_CHECKING:
    from sim.fem.assembly import Assembly


class State:
    """Displacements, contact and history of B environments, in units of thickness and modulus."""

    def __init__(self, assembly: Assembly, scenes) -> None:
        real, device, mesh = assembly.real, assembly.device, assembly.mesh
        vec3, mat33 = vector_of(real), matrix_of(real)
        count, nodes, elements = len(scenes), len(mesh.nodes), len(mesh.elements)
        points = (count, len(mesh.faces), assembly.points)
        on = set(assembly.effects)
        none2, none3 = (0, 0), (0, 0, 0)
        self._real, self._device, self._effects = real, device, on

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        self.everyone = wp.ones(count, dtype=wp.int32, device=device)
        """A mask with every environment."""
        self.tip = zeros(count, vec3)
        """Tip of the indenter (B,)."""
        self.tip_old = zeros(count, vec3)
        self.u = zeros((count, nodes), vec3)
        """Displacement of the nodes (B, N)."""
        self.u_old = zeros((count, nodes), vec3)
        """The same at the last accepted step."""
        self._u_before = zeros((count, nodes), vec3)
        self.pressure = zeros(points, real)
        """Contact pressure (B, S, P)."""
        self.normal = zeros(points, vec3)
        """Unit normal out of the indenter where there is contact (B, S, P)."""

        rubbing = points if "friction" in on else none3
        self.traction = zeros(rubbing, vec3)
        """Shear traction on the body (B, S, P); of length zero without friction."""
        self._traction_old = zeros(rubbing, vec3)
        self.limit = zeros(rubbing, real)
        """Pressure that limits friction (B, S, P)."""
        self._limit_relaxed = zeros(rubbing, real)
        self._coefficient = self._array(assembly.coefficients, real)

        self._branches = Branches(real, scenes, elements, device) if "viscosity" in on else None
        ones = wp.ones(count, dtype=real, device=device)
        self.viscous = (
            ones,
            ones,
            self._branches.history if self._branches else zeros(none3, mat33),
            self._branches.bulk_history if self._branches else zeros(none2, real),
        )
        """Factors on stress and pressure (B,), and their histories: the element kernels' inputs."""

        moving = (count, nodes) if "inertia" in on else none2
        self.rates = np.zeros(count)
        """The same as `inertia_rate`, on the host."""
        self.predicted = zeros(moving, vec3)
        """Where the nodes would be without forces (B, N)."""
        self._velocity = np.zeros((*moving, 3))
        self.inertia_rate = zeros(count if "inertia" in on else 0, real)
        """Mass of a unit volume over step squared (B,)."""
        bodies = [scene.body for scene in scenes]
        self._mass = np.array(
            [
                getattr(scene.effects.inertia, "scale", 0.0)
                * body.density
                * body.thickness**2
                / body.modulus
                for scene, body in zip(scenes, bodies, strict=True)
            ]
        )
        self.weight = self._array(
            [
                np.array(scene.effects.gravity.acceleration)
                * (body.density * body.thickness / body.modulus)
                for scene, body in zip(scenes, bodies, strict=True)
            ]
            if "gravity" in on
            else np.zeros((0, 3)),
            vec3,
        )
        """Weight of a unit volume (B,); of length zero without gravity."""

    def friction(self, stick) -> tuple:
        """The contact kernel's friction arguments."""
        return (
            self._coefficient,
            stick,
            self.tip_old,
            self.u_old,
            self._traction_old,
            self.limit,
        )

    def begin_step(self, tip: np.ndarray, duration: np.ndarray, guess: np.ndarray) -> None:
        """Move the tip to `tip` (B, 3) within `duration` (B,) [s]; start from an extrapolation.

        `guess` (B,) is the share of the last accepted change of `u` that is added to it.
        """
        self.tip.assign(self._array(tip, self.tip.dtype))
        extrapolate(self._array(guess, self._real), self.u_old, self._u_before, self.u)
        if self._branches is not None:
            factor, bulk_factor = self._branches.begin(duration)
            self.viscous = (
                self._array(factor, self._real),
                self._array(bulk_factor, self._real),
                self._branches.history,
                self._branches.bulk_history,
            )
        if "inertia" in self._effects:
            step = np.maximum(duration, 1e-12)
            self.rates = self._mass / step**2
            self.inertia_rate.assign(self._array(self.rates, self._real))
            flown = self.u_old.numpy().astype(float) + self._velocity * step[:, None, None]
            self.predicted.assign(self._array(flown, self.predicted.dtype))

    def settle_limit(self, active) -> None:
        """Take the pressure of the state last evaluated as the limit of friction."""
        copy_active(active, self.pressure, self.limit)

    def relax_limit(self, active, share: float) -> None:
        """Move the limit of friction by `share` of the way from where it was relaxed to last."""
        blend(active, share, self.pressure, self._limit_relaxed)
        copy_active(active, self._limit_relaxed, self.limit)

    def accept(self, active, duration: np.ndarray, mesh, material) -> None:
        """Make the present state of `active` environments the start of their next step."""
        if self._branches is not None:
            self._branches.keep(mesh, material, active, self.u)
        if "inertia" in self._effects:
            change = self.u.numpy().astype(float) - self.u_old.numpy()
            moved = active.numpy().astype(bool)
            step = np.maximum(duration[moved], 1e-12)[:, None, None]
            self._velocity[moved] = change[moved] / step
        copy_active(active, self.u_old, self._u_before)
        copy_active(active, self.u, self.u_old)
        if "friction" in self._effects:
            copy_active(active, self.traction, self._traction_old)
        chosen = active.numpy().astype(bool)[:, None]
        self.tip_old.assign(
            self._array(np.where(chosen, self.tip.numpy(), self.tip_old.numpy()), self.tip.dtype)
        )

    def _array(self, values, dtype):
        scalar = numpy_of(self._real)
        return wp.array(
            np.ascontiguousarray(np.asarray(values, dtype=scalar)), dtype=dtype, device=self._device
        )
