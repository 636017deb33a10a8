# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Contact with a rigid signed distance function at Gauss points of the faces, with friction.

Normal: augmented Lagrangian (Simo & Laursen 1992). The pressure is multiplier + penalty *
penetration where that is positive, along the gradient of the distance. The multiplier is the
pressure of an earlier state of the same point. Updating it until the penetration vanishes gives the
solution of a stiff penalty with a soft one, whose equations are easier to solve.

Friction: the traction of the last converged step, advanced by a tangential spring and cut back to
coefficient * pressure (return mapping; Wriggers, Computational Contact Mechanics, 2006, section
5.2). The pressure in that limit is an input, which keeps the derivative symmetric; the Newton loop
updates it until it is the pressure of the same state.

All quantities are per undeformed area. One thread per face of each environment.
"""

import functools

import numpy as np
import warp as wp

from sim.fem.arrays import contact_struct, mesh_struct
from sim.fem.self_overlap import FOLDED, SIDES
from sim.indenters.device import PLAIN, Traits, distance_function, table_struct
from sim.scalars import matrix_of, vector_of

# Step of the finite difference of the normal, in thicknesses.
REACH = 2e-3
# Gauss points along each edge of a face.
POINTS = 2
# Stiffness of sticking over the penalty: the springs that hold a point before it slips stretch by
# 1/100 of the thickness when the shear traction equals the modulus.
STICK = 0.5


def face_rule(points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return shape functions (P, 4) and weights (P,) at `points` x `points` Gauss points."""
    place, weight = np.polynomial.legendre.leggauss(points)
    first = np.stack([1 - place, 1 + place], axis=1) / 2
    shape = np.einsum("pi,qj->pqij", first, first).reshape(-1, 4)
    return shape, np.outer(weight, weight).ravel()


@functools.cache
def contact_kernels(real, friction: bool, traits: Traits = PLAIN):
    """Return the kernels (contact, tangent); without `friction` none of its code is compiled.

    `traits` are those of the indenters' table.
    """
    vec3 = vector_of(real)
    mat33 = matrix_of(real)
    table_type = table_struct(real, traits)
    distance = distance_function(real, traits)
    zero, half, one = real(0.0), real(0.5), real(1.0)
    tiny = real(1.0e-20)
    reach = real(REACH)

    @wp.func
    def bend(table: table_type, env: int, place: vec3, normal: vec3, along: vec3):
        """Return the derivative of the normal along a tangent, in the tangent plane."""
        ahead = distance(table, env, place + along * reach)
        turn = (vec3(ahead[0], ahead[1], ahead[2]) - normal) / reach
        return turn - normal * wp.dot(normal, turn)

    @wp.func
    def curvature(table: table_type, env: int, place: vec3, normal: vec3):
        """Return the derivative of the normal, symmetric, by finite differences."""
        helper = vec3(one, zero, zero)
        if wp.abs(normal[0]) > real(0.7):
            helper = vec3(zero, one, zero)
        first = wp.normalize(wp.cross(normal, helper))
        second = wp.cross(normal, first)
        bent = wp.outer(bend(table, env, place, normal, first), first)
        bent += wp.outer(bend(table, env, place, normal, second), second)
        return (bent + wp.transpose(bent)) * half

    @wp.kernel(enable_backward=False, module="unique")
    def contact(
        mesh: mesh_struct(real),
        table: table_type,
        # In and out:
        state: contact_struct(real),
        # In:
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
    ):
        env, s = wp.tid()
        if active[env] == 0:
            return
        m = mesh.variant[env]
        if mesh.area[m, s] == zero:  # outside a round body
            return
        n0 = mesh.faces[s, 0]
        n1 = mesh.faces[s, 1]
        n2 = mesh.faces[s, 2]
        n3 = mesh.faces[s, 3]
        tip = state.tip[env]
        x0 = mesh.nodes[m, n0] + u[env, n0] - tip
        x1 = mesh.nodes[m, n1] + u[env, n1] - tip
        x2 = mesh.nodes[m, n2] + u[env, n2] - tip
        x3 = mesh.nodes[m, n3] + u[env, n3] - tip
        f0 = vec3()
        f1 = vec3()
        f2 = vec3()
        f3 = vec3()
        touched = int(0)
        energy = real(0.0)
        for p in range(mesh.rule.shape[0]):
            a0 = mesh.shape[p, 0]
            a1 = mesh.shape[p, 1]
            a2 = mesh.shape[p, 2]
            a3 = mesh.shape[p, 3]
            place = x0 * a0 + x1 * a1 + x2 * a2 + x3 * a3
            answer = distance(table, env, place)
            pressure = state.multiplier[env, s, p] - state.penalty * answer[3]
            if pressure > zero:
                touched += 1
                normal = vec3(answer[0], answer[1], answer[2])
                w = mesh.rule[p] * mesh.area[m, s]
                energy += half * w * pressure * pressure / state.penalty
                matrix = wp.outer(normal, normal) * state.penalty
                if state.convex[env] == 0:
                    matrix -= curvature(table, env, place, normal) * pressure
                traction = vec3()
                if wp.static(friction):
                    slip = (
                        (u[env, n0] - state.u_old[env, n0]) * a0
                        + (u[env, n1] - state.u_old[env, n1]) * a1
                        + (u[env, n2] - state.u_old[env, n2]) * a2
                        + (u[env, n3] - state.u_old[env, n3]) * a3
                        - (tip - state.tip_old[env])
                    )
                    spring = state.stick * state.penalty
                    trial = state.traction_old[env, s, p] - slip * spring
                    trial = trial - normal * wp.dot(normal, trial)
                    size = wp.length(trial)
                    most = state.coefficient[env] * state.limit[env, s, p]
                    tangent_plane = wp.identity(n=3, dtype=real) - wp.outer(normal, normal)
                    if size <= most:
                        traction = trial
                        energy += half * w * size * size / spring
                        matrix += tangent_plane * spring
                    else:
                        along = trial / wp.max(size, tiny)
                        traction = along * most
                        energy += w * most * (size - half * most) / spring
                        ratio = spring * most / wp.max(size, tiny)
                        matrix += (tangent_plane - wp.outer(along, along)) * ratio
                    state.traction[env, s, p] = traction
                push = (normal * pressure + traction) * w
                state.normal[env, s, p] = normal
                state.matrix[env, s, p] = matrix * w
                f0 += push * a0
                f1 += push * a1
                f2 += push * a2
                f3 += push * a3
            else:
                pressure = zero
                state.matrix[env, s, p] = mat33()
                if wp.static(friction):
                    state.traction[env, s, p] = vec3()
            state.pressure[env, s, p] = pressure
        state.touched[env, s] = touched
        state.energy[env, s] = energy
        state.force[env, s, 0] = f0
        state.force[env, s, 1] = f1
        state.force[env, s, 2] = f2
        state.force[env, s, 3] = f3

    @wp.kernel(enable_backward=False, module="unique")
    def tangent(
        mesh: mesh_struct(real),
        # `force` becomes the derivative of -force, for faces that are touched
        state: contact_struct(real),
        active: wp.array(dtype=wp.int32),
        v: wp.array2d(dtype=vec3),
    ):
        env, s = wp.tid()
        if active[env] == 0 or state.touched[env, s] == 0:
            return
        v0 = v[env, mesh.faces[s, 0]]
        v1 = v[env, mesh.faces[s, 1]]
        v2 = v[env, mesh.faces[s, 2]]
        v3 = v[env, mesh.faces[s, 3]]
        f0 = vec3()
        f1 = vec3()
        f2 = vec3()
        f3 = vec3()
        for p in range(mesh.rule.shape[0]):
            a0 = mesh.shape[p, 0]
            a1 = mesh.shape[p, 1]
            a2 = mesh.shape[p, 2]
            a3 = mesh.shape[p, 3]
            t = state.matrix[env, s, p] * (v0 * a0 + v1 * a1 + v2 * a2 + v3 * a3)
            f0 += t * a0
            f1 += t * a1
            f2 += t * a2
            f3 += t * a3
        state.force[env, s, 0] = f0
        state.force[env, s, 1] = f1
        state.force[env, s, 2] = f2
        state.force[env, s, 3] = f3

    return contact, tangent


# Overlap of skin and indenter, and of skin and base plane, measured by sampling.
#
# The solver enforces contact at four points of a face. This kernel checks the points between them:
# every face that can reach the indenter is sampled densely, at the end of a step and on the way to
# it, where skin and tip are assumed to move straight. A signed distance changes by no more than the
# distance that a point moves. So no point of a face is deeper than its deepest sample plus the
# distance to the next one. Inside a wall a signed distance ends at half the wall's width; steps are
# shorter than that, and a face that leaps further is sampled once for each of its own lengths.
#
# Skin can only meet other skin where some of it has turned by a right angle or more. The kernel
# flags faces that have nearly done so, and `sim.fem.self_overlap` then looks closer.
#
# Lengths in thicknesses. One thread per face of each environment.

# Measured columns: deepest sample, upper bound of the depth, depth below the base plane, and 1 if
# a face is folded.
OVERLAPS = 4
# Most states along a step at which a face is sampled.
STATES_MOST = 32


@functools.cache
def overlap_kernel(real, traits: Traits = PLAIN):
    """Return the kernel that measures overlap; `traits` are those of the indenters' table."""
    vec3 = vector_of(real)
    table_type = table_struct(real, traits)
    distance = distance_function(real, traits)
    zero, half, one, quarter = real(0.0), real(0.5), real(1.0), real(0.25)
    turned = real(FOLDED)

    @wp.kernel(enable_backward=False, module="unique")
    def overlap(
        mesh: mesh_struct(real),
        table: table_type,
        contact: contact_struct(real),
        # In: samples along a side, and states along the step
        samples: int,
        states: int,
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        # Out: of each face (B, S, OVERLAPS), and the largest of each environment (B, OVERLAPS)
        face_out: wp.array3d(dtype=real),
        most_out: wp.array2d(dtype=real),
    ):
        env, s = wp.tid()
        if active[env] == 0:
            return
        m = mesh.variant[env]
        if mesh.area[m, s] == zero:  # outside a round body
            return
        deepest = zero
        bound = zero
        below = zero
        folded = zero
        n0 = mesh.faces[s, 0]
        n1 = mesh.faces[s, 1]
        n2 = mesh.faces[s, 2]
        n3 = mesh.faces[s, 3]
        travel = contact.tip[env] - contact.tip_old[env]
        d0 = contact.u_old[env, n0] - u[env, n0]
        d1 = contact.u_old[env, n1] - u[env, n1]
        d2 = contact.u_old[env, n2] - u[env, n2]
        d3 = contact.u_old[env, n3] - u[env, n3]
        first = mesh.nodes[m, n3] - mesh.nodes[m, n0]
        second = mesh.nodes[m, n2] - mesh.nodes[m, n1]
        count = int(states)
        if states > 1:
            # A face that leaps over many of its own lengths could miss a thin indenter.
            size = wp.min(wp.length(first), wp.length(second))
            leap = wp.max(
                wp.max(wp.length(d0 + travel), wp.length(d1 + travel)),
                wp.max(wp.length(d2 + travel), wp.length(d3 + travel)),
            )
            count = wp.clamp(int(wp.ceil(leap / size)), states, wp.max(states, STATES_MOST))
        for k in range(count):
            left = one - real(k + 1) / real(count)
            at = contact.tip[env] - travel * left
            x0 = mesh.nodes[m, n0] + u[env, n0] + d0 * left
            x1 = mesh.nodes[m, n1] + u[env, n1] + d1 * left
            x2 = mesh.nodes[m, n2] + u[env, n2] + d2 * left
            x3 = mesh.nodes[m, n3] + u[env, n3] + d3 * left
            lowest = wp.min(wp.min(x0[2], x1[2]), wp.min(x2[2], x3[2]))
            below = wp.max(below, -one - lowest)
            middle = (x0 + x1 + x2 + x3) * quarter
            reach = wp.max(
                wp.max(wp.length(x0 - middle), wp.length(x1 - middle)),
                wp.max(wp.length(x2 - middle), wp.length(x3 - middle)),
            )
            answer = distance(table, env, middle - at)
            if answer[3] < reach:
                # Largest distance of a point of the face from the nearest sample.
                along = wp.max(wp.length(x2 - x0), wp.length(x3 - x1))
                across = wp.max(wp.length(x1 - x0), wp.length(x3 - x2))
                spacing = wp.sqrt(along * along + across * across) * half / real(samples)
                for i in range(samples):
                    a = (real(i) + half) / real(samples)
                    for j in range(samples):
                        b = (real(j) + half) / real(samples)
                        place = (x0 * (one - b) + x1 * b) * (one - a) + (
                            x2 * (one - b) + x3 * b
                        ) * a
                        found = distance(table, env, place - at)
                        deepest = wp.max(deepest, -found[3])
                        bound = wp.max(bound, spacing - found[3])
            if k == count - 1:
                now = wp.cross(x3 - x0, x2 - x1)
                rest = wp.cross(first, second)
                if wp.dot(rest, now) < turned * wp.length(rest) * wp.length(now):
                    folded = one
        face_out[env, s, 0] = deepest
        face_out[env, s, 1] = bound
        face_out[env, s, 2] = below
        face_out[env, s, 3] = folded
        wp.atomic_max(most_out, env, 0, deepest)
        wp.atomic_max(most_out, env, 1, bound)
        wp.atomic_max(most_out, env, 2, below)
        wp.atomic_max(most_out, env, 3, folded)

    return overlap


# Does a folded skin need a closer look? A test on the GPU that never says no to one that does.
#
# `sim.fem.self_overlap` looks at skins on the host, which the GPU waits for. Most of them are bent
# around an edge and touch nothing. Here each surface node around the folded faces is tested against
# the bounding boxes of all elements, and against planes that an element lies on one side of, as
# there but with a margin for float32. Only where a node passes both is there anything to look at.
#
# For each surface node of each environment, `NODE_LANES` threads share the elements: few
# environments have folds, and one thread for each of their nodes does not fill a GPU (5 ms a test
# on an H200). On a CPU it takes longer than the look itself.

# Part of an element's size by which a node may be outside of it and still be looked at. Places have
# 24 bits, and the smallest elements about a thousandth of a body's size.
MARGIN = 1e-3
# Threads that go through the elements for one node.
NODE_LANES = 32
# Marks in the column of folds of `OVERLAPS`, where a face folded has 1.
MAY_CROSS = 2.0


@functools.cache
def _crossing_kernels(real):
    vec3 = vector_of(real)
    mat83 = wp.types.matrix(shape=(8, 3), dtype=real)
    zero, margin, mark = real(0.0), real(MARGIN), real(MAY_CROSS)

    @wp.func
    def extent(low: vec3, high: vec3):
        return wp.max(wp.max(high[0] - low[0], high[1] - low[1]), high[2] - low[2])

    @wp.kernel(enable_backward=False, module="unique")
    def surround(
        mesh: mesh_struct(real),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        face_overlap: wp.array3d(dtype=real),
        # Out: least and greatest corner of the folded faces, and the greatest extent of one (B, 7)
        box_out: wp.array2d(dtype=real),
    ):
        env, s = wp.tid()
        if active[env] == 0 or face_overlap[env, s, 3] == zero:
            return
        m = mesh.variant[env]
        low = mesh.nodes[m, mesh.faces[s, 0]] + u[env, mesh.faces[s, 0]]
        high = low
        for corner in range(1, 4):
            place = mesh.nodes[m, mesh.faces[s, corner]] + u[env, mesh.faces[s, corner]]
            low = wp.min(low, place)
            high = wp.max(high, place)
        for axis in range(3):
            wp.atomic_min(box_out, env, axis, low[axis])
            wp.atomic_max(box_out, env, 3 + axis, high[axis])
        wp.atomic_max(box_out, env, 6, extent(low, high))

    @wp.kernel(enable_backward=False, module="unique")
    def cross(
        mesh: mesh_struct(real),
        sides: wp.array2d(dtype=wp.int32),
        skin: wp.array(dtype=wp.int32),
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        box: wp.array2d(dtype=real),
        # In and out:
        most_out: wp.array2d(dtype=real),
    ):
        env, s, lane = wp.tid()
        if active[env] == 0 or box[env, 6] <= zero:
            return
        m = mesh.variant[env]
        node = skin[s]
        point = mesh.nodes[m, node] + u[env, node]
        around = box[env, 6] * (real(1.0) + margin)
        for axis in range(3):
            if point[axis] < box[env, axis] - around or point[axis] > box[env, 3 + axis] + around:
                return
        corner = mat83()
        for e in range(lane, mesh.elements.shape[0], NODE_LANES):
            low = vec3()
            high = vec3()
            apart = int(0)
            for c in range(8):
                n = mesh.elements[e, c]
                if n == node:
                    apart = int(1)
                away = mesh.nodes[m, n] + u[env, n] - point
                corner[c] = away
                if c == 0:
                    low = away
                    high = away
                low = wp.min(low, away)
                high = wp.max(high, away)
            slack = margin * extent(low, high)
            for axis in range(3):
                if low[axis] > slack or high[axis] < -slack:
                    apart = int(1)
            if apart == 0:
                for side in range(6):
                    first = corner[sides[2, side]] - corner[sides[0, side]]
                    second = corner[sides[3, side]] - corner[sides[1, side]]
                    normal = wp.cross(first, second)
                    below = wp.dot(normal, corner[0])
                    above = below
                    for c in range(1, 8):
                        height = wp.dot(normal, corner[c])
                        below = wp.min(below, height)
                        above = wp.max(above, height)
                    room = margin * wp.max(wp.abs(below), wp.abs(above))
                    if below > room or above < -room:
                        apart = int(1)
            if apart == 0:
                most_out[env, 3] = mark
                return

    return surround, cross


class Crossing:
    """The test for B environments with the same surface, faces (S, 4); it owns a work array."""

    def __init__(self, real, environments: int, faces: np.ndarray, device: str) -> None:
        self._device, (self._surround, self._cross) = device, _crossing_kernels(real)
        self._skin = wp.array(np.unique(faces).astype(np.int32), dtype=wp.int32, device=device)
        self._sides = wp.array(SIDES.astype(np.int32), dtype=wp.int32, device=device)
        none = np.repeat([np.inf, -np.inf, 0.0], [3, 3, 1])
        self._none = wp.array(np.tile(none, (environments, 1)), dtype=real, device=device)
        self._box = wp.clone(self._none)

    def mark(self, mesh, active, u, face_overlap, most_overlap) -> None:
        """Write `MAY_CROSS` into the last column of `most_overlap` (B, 4) where a look is needed.

        Both overlaps are as measured by `overlap_kernel`, those of faces (B, S, 4).
        """
        wp.copy(self._box, self._none)
        wp.launch(
            self._surround,
            dim=(len(self._box), len(mesh.faces)),
            inputs=[mesh, active, u, face_overlap],
            outputs=[self._box],
            device=self._device,
        )
        wp.launch(
            self._cross,
            dim=(len(self._box), len(self._skin), NODE_LANES),
            inputs=[mesh, self._sides, self._skin, active, u, self._box],
            outputs=[most_overlap],
            device=self._device,
        )
