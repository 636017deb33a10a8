# mypy: ignore-errors
# Warp's arrays and kernels are typed at run time; mypy cannot follow them.
"""Device data of one batch: mesh, material and state, and the resulting forces.

Units: lengths in thicknesses T, stresses in moduli E, forces in E T^2, times in seconds. So the
arithmetic does not depend on the units or stiffness of a scene.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from numpy.typing import NDArray

from sim.arrays import Array
from sim.fem import Fem
from sim.fem.arrays import (
    Graphs,
    array_of,
    axpy,
    blend,
    contact_struct,
    copy_active,
    extrapolate,
    fill,
    material_struct,
    mesh_on,
    vector_kernels,
)
from sim.fem.balance import (
    LANES,
    READ,
    READ_COLUMNS,
    RUN,
    SUMS,
    TOP,
    TOTALS,
    push_kernel,
    reading_kernels,
    reduce_kernel,
    residual_kernel,
    work_kernel,
)
from sim.fem.contact import OVERLAPS, POINTS, STICK, contact_kernels, face_rule, overlap_kernel
from sim.fem.element import Branches, VolumePressure, element_kernels, split_factor
from sim.fem.lanes import AT_ONCE, forces_kernel
from sim.fem.matrix import HALF_POISSON, BlockMatrix
from sim.fem.mesh import Mesh
from sim.fem.multigrid import Multigrid
from sim.indenters.device import IndenterTraits, PartTable, traits_of
from sim.scalars import PRECISIONS, matrix_of, numpy_of, vector_of
from sim.scene import Scene

# Position at which a tip touches nothing, in thicknesses.
AWAY = (0.0, 0.0, 1e3)

# Least force by which residuals are divided [E T^2], if elements are `WIDE` thicknesses long or
# longer: 2 mN in the paper's gel in float32, so that a tolerance of 1e-4 requires no more than
# 0.2 uN, about the limit of its digits. It falls with the area of the elements. Otherwise it would
# exceed the whole force of a contact that is small compared with the thickness: in a gel of 20 mm
# it was 58 mN, and a sphere of 0.5 mm, on which 1.9 mN act, had forces 2 % off.
MIN_FORCE_SCALE = {"float32": 1e-3, "float64": 1e-5}
WIDE = 1 / 12
# Most environments of a batch whose launches beside those of conjugate gradients are recorded as
# graphs. With more of them the device has enough to do, and masks of active ones rarely come again.
FEW = 16
# Change of the tip's velocity, over the velocity, from which motion is not smooth; and ratio of a
# step to the last one beyond which the second backward difference is not stable (1 + sqrt 2).
KINK, LONGER = 1e-3, 2.0
# Steps over the time of damping beyond which stresses are damped less: they resolve no such waves.
UNDAMPED = 4.0
# Least time over which stresses are damped, over that in which a shear wave crosses an element.
DAMPED = 0.15
# Masks of environments that are kept on the device.
MASKS = 8

# State of a batch: positions, and the history of the effects that are on.
#
# An effect that is off has arrays of length zero: no memory, no work.


class SolverState:
    """Displacements, contact and history of B environments, in units of thickness and modulus."""

    def __init__(self, assembly: Assembly, scenes) -> None:
        real, device, mesh = assembly.real, assembly.device, assembly.mesh
        vec3, mat33 = vector_of(real), matrix_of(real)
        count, nodes, elements = len(scenes), len(mesh.nodes), len(mesh.elements)
        faces = count, len(mesh.faces)
        points = (*faces, assembly.points)
        on = set(assembly.effects)
        none2, none3 = (0, 0), (0, 0, 0)
        rubbing = points if "friction" in on else none3
        self._real, self._device, self._effects = real, device, on

        def zeros(shape, dtype):
            return wp.zeros(shape, dtype=dtype, device=device)

        self._masks: dict[bytes, wp.array] = {}
        self.everyone = wp.ones(count, dtype=wp.int32, device=device)
        """Mask with every environment."""
        self.tip_before = np.zeros((count, 3))
        """Tip at the last accepted step (B, 3), on the host."""
        self._tip_after = np.zeros((count, 3))
        self._tip_now = np.zeros((count, 3))
        self.u = zeros((count, nodes), vec3)
        """Displacement of the nodes (B, N)."""
        self._u_before = zeros((count, nodes), vec3)
        contact = self.contact = contact_struct(real)()
        """Contact on the device."""
        contact.penalty, contact.stick = real(assembly.numerics.penalty), real(STICK)
        frictions = [scene.effects.friction for scene in scenes]
        self.coefficients = [getattr(friction, "coefficient", 0.0) for friction in frictions]
        """Coefficients of friction (B,)."""
        contact.coefficient = self._array(self.coefficients, real)
        for shape, dtype, names in (
            (count, wp.int32, ("convex",)),
            (count, vec3, ("tip", "tip_old")),
            ((count, nodes), vec3, ("u_old",)),
            (points, real, ("multiplier", "pressure")),
            (points, vec3, ("normal", "push")),
            (points, mat33, ("matrix",)),
            (rubbing, real, ("limit",)),
            (rubbing, vec3, ("traction", "traction_old")),
            (faces, wp.int32, ("touched",)),
            (faces, real, ("energy",)),
            ((*faces, 4), vec3, ("force",)),
        ):
            for name in names:
                setattr(contact, name, zeros(shape, dtype))
        self._multiplier_old = zeros(points, real)
        self._limit_relaxed = zeros(rubbing, real)

        self._branches = None
        if "viscosity" in on:
            self._branches = Branches(real, scenes, elements, device, stiffening=assembly.stiffens)
        self.volume = None
        """Split pressure of nearly incompressible bodies, if any."""
        prony = self._branches.arrays if self._branches else None
        bulk = prony.bulk_history if prony else zeros(none2, real)
        if assembly.split:
            poisson = np.array([scene.body.poisson for scene in scenes])
            self.volume = VolumePressure(real, poisson, elements, device, bulk if prony else None)
            bulk = self.volume.lagged
        self._bulk_growth = np.ones(count)
        bodies = [scene.body for scene in scenes]
        material = self.material = material_struct(real)()
        """Material on the device."""
        material.shear = self._array([body.shear_modulus / body.modulus for body in bodies], real)
        material.bulk = self._array([body.bulk_modulus / body.modulus for body in bodies], real)
        material.stiffening = self._array(assembly.stiffening, real)
        material.factor = wp.ones(count, dtype=real, device=device)
        fraction = self.volume.fraction if self.volume else np.ones(count)
        material.bulk_factor = self._array(fraction, real)
        material.history = prony.history if prony else zeros(none3, mat33)
        material.bulk_history = bulk

        moving = (count, nodes) if "inertia" in on else none2
        self.rates = np.zeros(count)
        """`inertia_rate` on the host."""
        self.predicted = zeros(moving, vec3)
        """Displacement that the nodes would have without forces (B, N)."""
        self.inner, self.inner_old = zeros(moving, vec3), zeros(moving, vec3)
        """Forces of the elements on the nodes, now and at the last accepted step (B, N)."""
        self.stiffer = zeros(count if "inertia" in on else 0, real)
        """Time of damping over the step (B,)."""
        self._still = zeros(moving, vec3)  # that they would have at rest
        self._way, self._way_before = zeros(moving, vec3), zeros(moving, vec3)
        self._times = np.ones((3, count))
        self._speed = np.zeros((count, 3))
        self.inertia_rate = zeros(count if "inertia" in on else 0, real)
        """Mass of a unit volume over step squared (B,)."""
        self._mass = np.array(
            [
                getattr(scene.effects.inertia, "scale", 0.0)
                * body.density
                * body.thickness**2
                / body.modulus
                for scene, body in zip(scenes, bodies, strict=True)
            ]
        )
        self._damped = np.array(list(map(damping_time, scenes, assembly.meshes)))
        self._weight = np.zeros((0, 3))
        if "gravity" in on:
            self._weight = np.array(
                [
                    np.array(scene.effects.gravity.acceleration)
                    * (body.density * body.thickness / body.modulus)
                    for scene, body in zip(scenes, bodies, strict=True)
                ]
            )
        self.weight = self._array(self._weight, vec3)
        """Weight of a unit volume (B,); of length zero without gravity."""

    def start(self, tip: np.ndarray) -> None:
        """Put the tips at their positions before the first step (B, 3)."""
        self.tip_before[:] = self._tip_after[:] = tip
        self._put(self.contact.tip_old, tip)
        self.set_tip(np.ones(len(tip), bool))

    def history(self, chosen: Sequence[int]) -> dict[str, np.ndarray]:
        """Return copies of all that the next step of the chosen environments (C,) depends on."""
        rows = list(chosen)
        history = {
            name: np.take(array.numpy(), rows, axis=axis)
            for name, (array, axis) in self._history().items()
        }
        history["tip"], history["speed"] = self.tip_before[rows], self._speed[rows]
        history["times"] = self._times[:, rows]
        return history

    def go_on(self, history: dict[str, np.ndarray]) -> None:
        """Begin from what `history` of another state, of any precision, has returned."""
        for name, (array, axis) in self._history().items():
            values = history[name][: len(array)] if axis else history[name]  # of fewer branches
            array.assign(values.astype(numpy_of(self._real)))
        copy_active(self.everyone, self.contact.u_old, self.u)
        copy_active(self.everyone, self._multiplier_old, self.contact.multiplier)
        if self.volume is not None:
            self.volume.roll_back(self.everyone)
        self._times[:], self._speed[:] = history["times"], history["speed"]
        self.start(history["tip"])

    def _history(self) -> dict:
        """Return the arrays of the last accepted state, and their axis of environments."""
        named = {
            "u": self.contact.u_old,
            "u_before": self._u_before,
            "way": self._way,
            "way_before": self._way_before,
            "inner": self.inner_old,
            "multiplier": self._multiplier_old,
            "push": self.contact.push,
            "traction": self.contact.traction_old,
        }
        if self._branches is not None:
            named |= self._branches.state
        if self.volume is not None:
            named["pressure"] = self.volume.pressure_old
        return {
            name: (array, int(name.endswith("branch")))
            for name, array in named.items()
            if array.size
        }

    def begin_step(
        self, chosen: np.ndarray, tip: np.ndarray, duration: np.ndarray, guess: np.ndarray
    ) -> None:
        """Prepare the step of the chosen environments (B,) to `tip` (B, 3); `set_tip` moves them.

        The durations [s] are those of the current step of each environment, begun now or before;
        `u` begins with `guess` (B,), a fraction of its last accepted change.
        """
        self._tip_after[chosen] = tip[chosen]
        active = self.mask(chosen)
        fraction = self._array(guess, self._real)
        extrapolate(active, fraction, self.contact.u_old, self._u_before, self.u)
        self._remember(active, duration)
        self._foresee(active, duration)

    def _remember(self, active, duration: np.ndarray) -> None:
        """Set the material's history, `duration` (B,) [s] after the last step."""
        if self._branches is not None:
            stress, self._bulk_growth = self._branches.begin(active, duration)
            self._put(self.material.factor, stress)
        self.follow_volume(active)

    def follow_volume(self, active) -> None:
        """Update the factor on pressures, and the part of them that does not follow the volume."""
        factor = self._bulk_growth
        if self.volume is not None:
            factor = factor * self.volume.fraction
            self.volume.compose(active)
        if self.volume is not None or self._branches is not None:
            self._put(self.material.bulk_factor, factor)

    def _foresee(self, active, duration: np.ndarray) -> None:
        """Predict the motion of mass without forces in the step of `duration` (B,) [s].

        By the second backward difference, of second order and stable for any step (BDF2; Hairer &
        Wanner, Solving Ordinary Differential Equations II, 1996, section V.1), for displacement and
        velocity: u' = (u - still) / span, u'' = (u' - the same of u') / span. Where the tip changes
        its velocity, or the step is much longer than the last one, by backward Euler.
        """
        if "inertia" not in self._effects:
            return
        last, span, before = self._times
        moves = duration > 0  # a motion in no time ends at rest
        kink = np.linalg.norm(self.step - self._speed * duration[:, None], axis=1)
        smooth = kink <= KINK * np.linalg.norm(self.step, axis=1)
        ratio = np.where(moves & smooth, duration / last, 0.0)
        ratio[ratio > LONGER] = 0.0
        onward, now = ratio**2 / (1 + 2 * ratio), duration * (1 + ratio) / (1 + 2 * ratio)
        self.rates = np.divide(self._mass, now**2, where=moves, out=np.zeros(len(now)))
        self._put(self.inertia_rate, self.rates)
        short = np.divide(self._damped, duration, where=moves, out=np.zeros(len(now)))
        self._put(self.stiffer, short * np.minimum(1.0, UNDAMPED * short))
        last_share, before_share = now * (1 + onward) / span, -now * onward / before
        self._now = np.where(moves, now, np.inf)

        def along(length, start, direction, out) -> None:
            axpy(active, self._array(length, self._real), start, direction, out)

        fraction = self._array(onward, self._real)
        extrapolate(active, fraction, self.contact.u_old, self._u_before, self._still)
        along(last_share, self._still, self._way, self.predicted)
        along(before_share, self.predicted, self._way_before, self.predicted)

    def _move(self, active, chosen: np.ndarray, duration: np.ndarray) -> None:
        """Keep the motion of the chosen environments (B,) in the step of `duration` (B,) [s]."""
        if "inertia" not in self._effects:
            return
        copy_active(active, self._way, self._way_before)
        copy_active(active, self.inner, self.inner_old)
        back = self._array(np.full(len(chosen), -1.0), self._real)
        axpy(active, back, self.u, self._still, self._way)
        moves = np.where(duration > 0, duration, np.inf)
        self._times[:, chosen] = np.array([moves, self._now, self._times[1]])[:, chosen]
        self._speed[chosen] = (self.step / moves[:, None])[chosen]

    def put_within(self, chosen: np.ndarray, fraction: float, duration: np.ndarray, way) -> None:
        """Set history and predicted motion of the chosen (B,) for a fraction of their step.

        `duration` (B,) [s] is that of the whole step, and `way` (B, N) the displacement of the
        nodes over it, with constant acceleration.
        """
        active = self.mask(chosen)
        if self.volume is not None:
            self.volume.put_within(active, fraction)
        self._remember(active, np.where(chosen, fraction, 1.0) * duration)
        if "inertia" in self._effects:
            self._foresee(active, duration)
            back = self._array(np.full(len(chosen), fraction - 1.0), self._real)
            axpy(active, back, self.predicted, way, self.predicted)

    def put_weight(self, fraction: np.ndarray) -> None:
        """Set the fraction of their weight that bodies have (B,)."""
        self._put(self.weight, self._weight * fraction[:, None])

    def put_tip_away(self, chosen: np.ndarray) -> None:
        """Move the tips of the chosen environments (B,) to where they touch nothing."""
        self._tip_now[chosen] = AWAY
        self._put(self.contact.tip, self._tip_now)

    def set_tip(self, chosen: np.ndarray, *, before: bool = False) -> None:
        """Put the tips of the chosen environments (B,) at the end of their step, or its start."""
        if not chosen.any():
            return
        self._tip_now[chosen] = (self.tip_before if before else self._tip_after)[chosen]
        self._put(self.contact.tip, self._tip_now)

    @property
    def step(self) -> np.ndarray:
        """Displacement of the tips over their step (B, 3)."""
        return self._tip_after - self.tip_before

    def travel(self, chosen: np.ndarray):
        """Return `step` on the device (B,); 0 for environments that are not chosen."""
        return self._array(np.where(chosen[:, None], self.step, 0.0), self.contact.tip.dtype)

    def update_multiplier(self, active) -> None:
        """Set the multiplier to the current pressure."""
        copy_active(active, self.contact.pressure, self.contact.multiplier)

    def rollback_step(self, active) -> None:
        """Roll back the changes of the step; `begin_step` resets the rest."""
        copy_active(active, self._multiplier_old, self.contact.multiplier)
        if self.volume is not None:
            self.volume.roll_back(active)

    def settle_limit(self, active) -> None:
        """Set the limit of friction to the pressure of the last evaluated state."""
        copy_active(active, self.contact.pressure, self.contact.limit)

    def relax_limit(self, active, fraction: float) -> None:
        """Move the limit of friction by `fraction` of the way from its last relaxed value."""
        blend(active, fraction, self.contact.pressure, self._limit_relaxed)
        copy_active(active, self._limit_relaxed, self.contact.limit)

    def accept(self, chosen: np.ndarray, duration: np.ndarray, mesh) -> None:
        """Make the current state of the chosen environments (B,) the start of their next step.

        All but the work of `store`.
        """
        if self._branches is not None:
            self._branches.keep(mesh, self.material, self.mask(chosen), self.u)
        self._move(self.mask(chosen), chosen, duration)
        self.tip_before[chosen] = self._tip_after[chosen]
        self._put(self.contact.tip_old, self.tip_before)

    def store(self, active) -> None:
        """Copy fields of the current state to those of the last accepted one."""
        copy_active(active, self.contact.u_old, self._u_before)
        copy_active(active, self.u, self.contact.u_old)
        copy_active(active, self.contact.pressure, self.contact.multiplier)
        copy_active(active, self.contact.pressure, self._multiplier_old)
        if self.volume is not None:
            self.volume.accept(active)
        if "friction" in self._effects:
            copy_active(active, self.contact.traction, self.contact.traction_old)

    def mask(self, chosen: np.ndarray):
        """Return the chosen environments (B,) as a mask for kernels, copied to a GPU once."""
        key = chosen.tobytes()
        if key not in self._masks:
            if len(self._masks) == MASKS:
                del self._masks[next(iter(self._masks))]
            mask = chosen.astype(np.int32)
            self._masks[key] = wp.array(mask, dtype=wp.int32, device=self._device)
        return self._masks[key]

    def _put(self, array, values) -> None:
        array.assign(np.ascontiguousarray(values, dtype=numpy_of(self._real)))

    def _array(self, values, dtype):
        return array_of(values, dtype, self._real, self._device)


def damping_time(scene: Scene, mesh: Mesh) -> float:
    """Return the time over which stresses are damped [s]; 0 without inertia.

    Stress is damped by this time times its rate, so that waves of a few elements, which no mesh
    carries, do not ring, however short the steps are. It is the time in which a wave of
    compression crosses the topmost element: then the force of an impact is density times speed of
    that wave times velocity and area at once, as of a continuum, where it would first have to
    cross the element.
    """
    inertia, body = scene.effects.inertia, scene.body
    if inertia is None:
        return 0.0
    density, height = inertia.scale * body.density, mesh.topmost * body.thickness
    wave, shear = (np.sqrt(density / one) for one in (body.wave_modulus, body.shear_modulus))
    return float(height * max(wave, DAMPED * shear))


def kernels_of(scenes: Sequence[Scene]) -> tuple[tuple[str, ...], IndenterTraits, bool]:
    """Return the sizes and effects that kernels of a batch are compiled for.

    The effects that are on, the traits of the indenters, and True if the pressure of one of the
    bodies is split (`sim.fem.element.VolumePressure`).
    """
    split = min(split_factor(scene.body.poisson) for scene in scenes) < 1.0
    return scenes[0].effects.key, traits_of([scene.indenter for scene in scenes]), split


class Assembly:
    """Equations of B presses on meshes of one topology: residual, tangent, preconditioner."""

    def __init__(
        self,
        meshes: Sequence[Mesh],
        scenes: Sequence[Scene],
        numerics: Fem,
        precision: str,
        device: str,
        stiffening: Sequence[float] | None = None,
    ) -> None:
        variants = list({id(mesh): mesh for mesh in meshes}.values())
        variant_of = {id(mesh): index for index, mesh in enumerate(variants)}
        self.meshes = list(meshes)
        """Mesh of each environment (B,)."""
        self.mesh = mesh = variants[0]
        """First of the meshes, for all that they share."""
        self.numerics, self.device = numerics, device
        self.precision = precision
        self.real = real = PRECISIONS[precision]
        self.finest = np.array([each.finest for each in meshes])
        """Side of the smallest elements in plan of each environment (B,) [T]."""
        self.min_force_scale = MIN_FORCE_SCALE[precision] * np.minimum(1.0, self.finest / WIDE) ** 2
        """Least force by which residuals are divided (B,) [E T^2]."""
        self.effects, traits, self.split = kernels_of(scenes)
        self.environments = len(scenes)
        vec3 = vector_of(real)
        rule = face_rule(POINTS)
        self.points = len(rule[1])
        on_gpu = wp.get_device(device).is_cuda
        kernel = element_kernels if on_gpu else forces_kernel
        self.stiffening = [numerics.stiffening] * len(scenes) if stiffening is None else stiffening
        """`Fem.stiffening` of each environment (B,)."""
        self.stiffens = any(self.stiffening)
        kind = "viscosity" in self.effects, self.split, self.stiffens
        self._element = kernel(real, *kind)
        self._element_threads = -(-len(mesh.elements) // (1 if on_gpu else AT_ONCE))
        self._lanes = LANES if on_gpu else 1
        self._graphs = Graphs(device, record=len(scenes) <= FEW)
        on = [name in self.effects for name in ("friction", "inertia", "gravity")]
        self._residual = residual_kernel(real, *on[1:], lanes=self._lanes)
        self._reduce = reduce_kernel(lanes=self._lanes)

        variant = [variant_of[id(each)] for each in meshes]
        self._mesh = mesh_on(device, variants, variant, rule, real, inertia=on[1])
        self._precise = self._mesh
        if real != wp.float64:
            self._precise = mesh_on(
                device, variants, variant, rule, wp.float64, elements=False, inertia=on[1]
            )
        indenters, unit = [scene.indenter for scene in scenes], scenes[0].body.thickness
        self._table = PartTable.pack(indenters, unit, real, device).struct
        self._contact = contact_kernels(real, "friction" in self.effects, traits)
        self._overlap = overlap_kernel(real, traits)
        self._work = work_kernel(real, "friction" in self.effects)
        self._push = push_kernel(real)
        vector_kernels(real)

        environments, count = self.environments, len(mesh.nodes)
        elements, faces = len(mesh.elements), len(mesh.faces)
        self._runs = -(-count // (RUN if self._lanes == 1 else LANES))
        self._shift = wp.zeros(environments, dtype=real, device=device)
        self._shift_now = np.zeros(environments)
        self._element_force = wp.zeros((environments, elements, 8), dtype=vec3, device=device)
        self.element_energy = wp.zeros((environments, elements), dtype=real, device=device)
        # Elements outside a round body keep this value.
        self._element_det = wp.ones((environments, elements), dtype=real, device=device)
        self._face_work = wp.zeros((environments, faces), dtype=real, device=device)
        self._sums = wp.zeros((environments, self._runs, SUMS), dtype=wp.float64, device=device)
        self._totals = wp.zeros((environments, SUMS), dtype=wp.float64, device=device)
        self.face_overlap = wp.zeros((environments, faces, OVERLAPS), dtype=real, device=device)
        """Overlap of each face, as written by `overlap` (B, S, `OVERLAPS`) [T]."""
        self._most_overlap = wp.zeros((environments, OVERLAPS), dtype=real, device=device)
        self.crossing = None
        """Test of folded skins on the device (`Crossing`); None: each gets a look on the host."""
        if on_gpu:
            from sim.fem.crossing import Crossing

            self.crossing = Crossing(real, environments, mesh.faces, device)
        self._field = wp.zeros((environments, count), dtype=vec3, device=device)
        self.sums = np.zeros(environments, TOTALS)
        """Sums over the last evaluated state (B,)."""
        self.residual = wp.zeros((environments, count), dtype=vec3, device=device)
        """Out-of-balance force of the last evaluated state (B, N) [E T^2]."""
        most = max(scene.body.poisson for scene in scenes)
        self.block_matrix = BlockMatrix(
            mesh,
            real,
            environments,
            device,
            viscous=kind[0],
            split=kind[1],
            stiffening=kind[2],
            # Short steps make inertia stiff without a bound, and the range of float16 is bounded.
            half=None if most <= HALF_POISSON and "inertia" not in self.effects else False,
            damped="inertia" in self.effects,
        )
        """Tangent of the last linearised state."""
        self.preconditioner = Multigrid(variants, variant, real, device)
        """Preconditioner of the tangent."""
        self.state = SolverState(self, scenes)
        """State of the batch."""
        self._read, self._read_top = reading_kernels(real, *on, lanes=self._lanes)
        self._read_inputs = [
            self._precise,
            self.state.contact,
            numerics.penalty,
            STICK * numerics.penalty,
            self._array(self.state.coefficients, wp.float64),
        ]
        self._rows = wp.zeros(
            (environments, READ_COLUMNS + TOP * mesh.top.size), dtype=wp.float64, device=device
        )

    def evaluate(self, active, u, direction) -> np.ndarray:
        """Compute forces at `u`; return `TOTALS` (B,), the slope along `direction` (B, N)."""
        self._graphs.repeat(self._launch_elements, active, u, direction)
        return self._sum()

    def depart(self, active, start, whole, direction) -> np.ndarray:
        """Store the current displacement as `start`, step along `direction`, and evaluate there.

        `whole` are lengths of 1 (B,).
        """
        self._graphs.repeat(self._launch_step, active, start, whole, direction)
        return self._sum()

    def evaluate_contact(self, active, u, direction, *, settle: bool = False) -> np.ndarray:
        """Evaluate again after only the friction limit has changed; `settle`: to the pressure."""
        self._graphs.repeat(self._launch_contact, active, u, direction, settle)
        return self._sum()

    def relax_limit(self, active, fraction: float) -> None:
        """Move the limit of friction by `fraction` of the way from its last relaxed value."""
        self._graphs.repeat(self.state.relax_limit, active, fraction)

    def _sum(self) -> np.ndarray:
        self.sums = self._totals.numpy().copy().view(TOTALS)[:, 0]
        return self.sums

    def _launch(self, kernel, dim, inputs, outputs=(), **options) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.device, **options)

    def _launch_step(self, active, start, whole, direction) -> None:
        copy_active(active, self.state.u, start)
        axpy(active, whole, start, direction, self.state.u)
        self._launch_elements(active, self.state.u, direction)

    def _launch_elements(self, active, u, direction) -> None:
        self._launch(
            self._element,
            (self.environments, self._element_threads),
            [self._mesh, self.state.material, active, u],
            [self._element_force, self.element_energy, self._element_det],
        )
        self._launch_contact(active, u, direction)

    def _launch_contact(self, active, u, direction, settle: bool = False) -> None:
        state = self.state
        if settle:
            state.settle_limit(active)
        by_face = self.environments, len(self.mesh.faces)
        self._launch(self._contact[0], by_face, [self._mesh, self._table, state.contact, active, u])
        self._launch(
            self._residual,
            (self.environments, self._runs * self._lanes),
            [
                *(self._mesh, state.contact, state.inertia_rate, state.predicted),
                *(state.stiffer, state.inner_old, state.weight),
                *(active, self._element_force, self._element_det, u, direction),
            ],
            [state.inner, self.residual, self._sums],
            block_dim=LANES,
        )
        self._launch(
            self._reduce,
            (self.environments, SUMS, self._lanes),
            [active, self._sums],
            [self._totals],
            block_dim=LANES,
        )

    def overlap(self, active, *, samples: int, states: int = 1) -> Array:
        """Return the overlap of skin with indenter and base plane (B, `OVERLAPS`).

        See `overlap_kernel`; the last column is 1 if the skin may overlap itself. Each side of a
        face has `samples`, and `states` go from the last accepted one to the current one, which
        counts.
        """
        self.measure_overlap(active, samples=samples, states=states)
        if self.crossing is None:
            return self._most_overlap.numpy().astype(float)
        self.crossing.mark(self._mesh, active, self.state.u, self.face_overlap, self._most_overlap)
        overlap = self._most_overlap.numpy().astype(float)
        overlap[:, 3] = self.crossing.marked(overlap[:, 3])
        return overlap

    def measure_overlap(self, active, *, samples: int, states: int = 1) -> None:
        """Measure the figures of `overlap`, for `read`."""
        state = self.state
        self._most_overlap.zero_()
        self._launch(
            self._overlap,
            (self.environments, len(self.mesh.faces)),
            [self._mesh, self._table, state.contact, samples, states, active, state.u],
            [self.face_overlap, self._most_overlap],
        )

    def read(self, environments: Sequence[int], tip: Array) -> tuple[NDArray, Array]:
        """Return `READ` of K environments in the last evaluated state, with tips at (B, 3).

        Overlaps are those that were measured last. Also displacement and force of the nodes of the
        top (K, X, Y, `TOP`).
        """
        state, count, top = self.state, len(environments), self.mesh.top
        which = self._array(list(environments), wp.int32)
        self._launch(
            self._read,
            (count, self._lanes),
            [
                *self._read_inputs,
                self._array(state.rates, wp.float64),
                *(state.predicted, state.weight, which, self._array(tip, wp.vec3d), state.u),
                *(self.element_energy, self.face_overlap, self._most_overlap),
            ],
            [self._rows],
            block_dim=LANES,
        )
        columns, levels = self.mesh.cells[0] * self.mesh.cells[1], self.mesh.cells[2] + 1
        self._launch(
            self._read_top,
            (count, top.size),
            [levels, columns, self._precise, state.contact, which, state.u],
            [self._rows],
        )
        rows = self._rows[:count].numpy().copy()
        read = rows[:, :READ_COLUMNS].copy().view(READ)[:, 0]
        return read, rows[:, READ_COLUMNS:].reshape(count, *top.shape, TOP)

    def rows(self, array, environments: Sequence[int]) -> np.ndarray:
        """Return the rows of a device array that belong to environments (K, ...)."""
        which = self._array(list(environments), wp.int32)
        return wp.indexedarray(array, [which, *[None] * (array.ndim - 1)]).numpy()

    def work(self, chosen: np.ndarray) -> np.ndarray:
        """Return the indenter's work over the step to the last evaluated state (B,) [E T^3].

        By the trapezoid rule. Call it once per step of the chosen environments (B,).
        """
        state = self.state
        self._launch(
            self._work,
            self._face_work.shape,
            [self._mesh, state.contact, state.mask(chosen), state.u, state.travel(chosen)],
            [self._face_work],
        )
        return self._face_work.numpy().sum(axis=1, dtype=float)

    def push(self, active, travel) -> None:
        """Write the forces of contact that moves by `travel` (B,) into `residual`.

        Contact and its stiffness are those of the last evaluated state, so these are the forces on
        a body that stands still. Solving for them gives the motion of the body with the tip.
        """
        fill(active, travel, self._field)
        by_face = self.environments, len(self.mesh.faces)
        inputs = [self._mesh, self.state.contact, active]
        self._launch(self._contact[1], by_face, [*inputs, self._field])
        self._launch(self._push, self.residual.shape, inputs, [self.residual])

    def make_convex(self, convex: np.ndarray) -> None:
        """Drop terms that may be negative from coming tangents, for environments `convex` (B,).

        These are the rotation of the pressure by the indenter's curvature, and the part that
        pressure adds to the stiffness of elements beyond a bound (`element.tangent_functions`).
        Forces do not change.
        """
        self.state.contact.convex.assign(convex.astype(np.int32))

    def linearise(self, active, u, damping: np.ndarray) -> None:
        """Fill `block_matrix` and `preconditioner` with the tangent of the evaluated state, `u`.

        `damping` (B,) [E / T^2] stiffens the tangent against any motion, but not the residual.
        """
        shift = (self.state.rates + damping).astype(numpy_of(self.real))
        if not np.array_equal(shift, self._shift_now):
            self._shift.assign(shift)
            self._shift_now = shift

        self._graphs.repeat(self._launch_tangent, active, u)
        self.preconditioner.factor_grids(active, self.block_matrix.matrix)

    def _launch_tangent(self, active, u) -> None:
        structs = self._mesh, self.state.material, self.state.contact
        self.block_matrix.assemble(active, u, *structs, self._shift, self.state.stiffer)
        self.preconditioner.factor(active, self.block_matrix.matrix)

    def settle_volume(self, active, direction) -> np.ndarray:
        """Let the split pressure follow the current state, and evaluate again; see `evaluate`."""
        state = self.state
        state.volume.settle(self._mesh, state.material, active, state.u)
        return self.evaluate(active, state.u, direction)

    def accept(self, chosen: np.ndarray, duration: np.ndarray) -> None:
        """Make the current state of the chosen environments (B,) the start of their next step."""
        self.state.accept(chosen, duration, self._mesh)
        self._graphs.repeat(self.state.store, self.state.mask(chosen))

    def _array(self, values, dtype):
        return array_of(values, dtype, self.real, self.device)
