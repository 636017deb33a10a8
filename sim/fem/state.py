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
        self._tip_old = zeros(count, vec3)
        self.tip_before = np.zeros((count, 3))
        """Where it was at the last accepted step (B, 3)."""
        self._tip_after = np.zeros((count, 3))
        self._tip_now = np.zeros((count, 3))
        self.u = zeros((count, nodes), vec3)
        """Displacement of the nodes (B, N)."""
        self.u_old = zeros((count, nodes), vec3)
        """The same at the last accepted step."""
        self._u_before = zeros((count, nodes), vec3)
        self.pressure = zeros(points, real)
        """Contact pressure (B, S, P)."""
        self.carried = zeros(points, real)
        """The part of it that needs no penetration (B, S, P)."""
        self._carried_old = zeros(points, real)
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
        self.viscous = (
            wp.ones(count, dtype=real, device=device),
            wp.ones(count, dtype=real, device=device),
            self._branches.history if self._branches else zeros(none3, mat33),
            self._branches.bulk_history if self._branches else zeros(none2, real),
        )
        """Factors on stress and pressure (B,), and their histories: the element kernels' inputs."""

        moving = (count, nodes) if "inertia" in on else none2
        self.rates = np.zeros(count)
        """The same as `inertia_rate`, on the host."""
        self.predicted = zeros(moving, vec3)
        """Where the nodes would be without forces (B, N)."""
        self._duration_old = np.ones(count)
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
            self._tip_old,
            self.u_old,
            self._traction_old,
            self.limit,
        )

    def start(self, tip: np.ndarray) -> None:
        """Put the tips where they are before the first step (B, 3)."""
        self.tip_before[:] = self._tip_after[:] = tip
        self._tip_old.assign(self._array(tip, self.tip.dtype))
        self.put_tip(np.ones(len(tip), bool))

    def begin_step(
        self, chosen: np.ndarray, tip: np.ndarray, duration: np.ndarray, guess: np.ndarray
    ) -> None:
        """Prepare the step of the chosen environments (B,) bool to `tip` (B, 3).

        Args:
            chosen: Those whose step begins.
            tip: Where their tips go; `put_tip` moves them.
            duration: Time of the step that each environment is in, begun now or before (B,) [s].
            guess: Share of the last accepted change of `u` that `u` begins with (B,).
        """
        self._tip_after[chosen] = tip[chosen]
        active = self._mask(chosen)
        share = self._array(guess, self._real)
        extrapolate(active, share, self.u_old, self._u_before, self.u)
        if self._branches is not None:
            for factor, values in zip(
                self.viscous[:2], self._branches.begin(active, duration), strict=True
            ):
                factor.assign(self._array(values, self._real))
        if "inertia" in self._effects:
            step = np.maximum(duration, 1e-12)
            self.rates = self._mass / step**2
            self.inertia_rate.assign(self._array(self.rates, self._real))
            share = self._array(step / self._duration_old, self._real)
            extrapolate(active, share, self.u_old, self._u_before, self.predicted)

    def put_tip(self, chosen: np.ndarray, *, before: bool = False) -> None:
        """Put the tips of the chosen environments (B,) where their step ends, or where it began."""
        if not chosen.any():
            return
        self._tip_now[chosen] = (self.tip_before if before else self._tip_after)[chosen]
        self.tip.assign(self._array(self._tip_now, self.tip.dtype))

    def travel(self, chosen: np.ndarray):
        """How far the tips of the chosen environments go in their step (B,); 0 for the others."""
        way = np.where(chosen[:, None], self._tip_after - self.tip_before, 0.0)
        return self._array(way, self.tip.dtype)

    def carry(self, active) -> None:
        """Let the present pressure be the one that needs no penetration."""
        copy_active(active, self.pressure, self.carried)

    def give_up(self, active) -> None:
        """Forget what the step has changed; `begin_step` resets the rest."""
        copy_active(active, self._carried_old, self.carried)

    def settle_limit(self, active) -> None:
        """Take the pressure of the state last evaluated as the limit of friction."""
        copy_active(active, self.pressure, self.limit)

    def relax_limit(self, active, share: float) -> None:
        """Move the limit of friction by `share` of the way from where it was relaxed to last."""
        blend(active, share, self.pressure, self._limit_relaxed)
        copy_active(active, self._limit_relaxed, self.limit)

    def accept(self, chosen: np.ndarray, duration: np.ndarray, mesh, material) -> None:
        """Make the present state of the chosen environments (B,) the start of their next step."""
        active = self._mask(chosen)
        if self._branches is not None:
            self._branches.keep(mesh, material, active, self.u)
        self._duration_old[chosen] = np.maximum(duration, 1e-12)[chosen]
        copy_active(active, self.u_old, self._u_before)
        copy_active(active, self.u, self.u_old)
        copy_active(active, self.pressure, self.carried)
        copy_active(active, self.pressure, self._carried_old)
        if "friction" in self._effects:
            copy_active(active, self.traction, self._traction_old)
        self.tip_before[chosen] = self._tip_after[chosen]
        self._tip_old.assign(self._array(self.tip_before, self.tip.dtype))

    def _mask(self, chosen: np.ndarray):
        return wp.array(chosen.astype(np.int32), dtype=wp.int32, device=self._device)

    def _array(self, values, dtype):
        scalar = numpy_of(self._real)
        return wp.array(
            np.ascontiguousarray(np.asarray(values, dtype=scalar)), dtype=dtype, device=self._device
        )
