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
import math

import numpy as np
import warp as wp

from sim.device import kernel
from sim.fem.arrays import contact_struct, mesh_struct
from sim.indenters.device import PLAIN, IndenterTraits, distance_function, table_struct
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
    abscissa, weight = np.polynomial.legendre.leggauss(points)
    first = np.stack([1 - abscissa, 1 + abscissa], axis=1) / 2
    shape = np.einsum("pi,qj->pqij", first, first).reshape(-1, 4)
    return shape, np.outer(weight, weight).ravel()


@functools.cache
def contact_kernels(real, friction: bool, traits: IndenterTraits = PLAIN):
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
    def curvature(table: table_type, env: int, place: vec3, normal: vec3):
        """Return the derivative of the normal, symmetric, by finite differences."""
        helper = vec3(one, zero, zero)
        if wp.abs(normal[0]) > real(0.7):
            helper = vec3(zero, one, zero)
        along = wp.normalize(wp.cross(normal, helper))
        bent = mat33()
        sides = int(2)  # a variable, or the loop is unrolled: each distance takes 0.3 s to compile
        for _side in range(sides):
            ahead = distance(table, env, place + along * reach)
            turn = (vec3(ahead[0], ahead[1], ahead[2]) - normal) / reach
            bent += wp.outer(turn - normal * wp.dot(normal, turn), along)
            along = wp.cross(normal, along)
        return (bent + wp.transpose(bent)) * half

    @kernel()
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

    @kernel()
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

# Cosine of the angle to its rest normal below which a face counts as folded.
FOLDED = math.cos(math.radians(80))
# Measured columns: deepest sample, upper bound of the depth, depth below the base plane, and 1 if
# a face is folded.
OVERLAPS = 4
# Most states along a step at which a face is sampled.
STATES_MOST = 32


@functools.cache
def overlap_kernel(real, traits: IndenterTraits = PLAIN):
    """Return the kernel that measures overlap; `traits` are those of the indenters' table."""
    vec3 = vector_of(real)
    table_type = table_struct(real, traits)
    distance = distance_function(real, traits)
    zero, half, one, quarter = real(0.0), real(0.5), real(1.0), real(0.25)
    turned = real(FOLDED)

    @kernel()
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
            # Largest distance of a point of the face from the nearest sample.
            along = wp.max(wp.length(x2 - x0), wp.length(x3 - x1))
            across = wp.max(wp.length(x1 - x0), wp.length(x3 - x2))
            spacing = wp.sqrt(along * along + across * across) * half / real(samples)
            for sample in range(-1, samples * samples):
                place = middle
                if sample >= 0:
                    a = (real(sample // samples) + half) / real(samples)
                    b = (real(sample % samples) + half) / real(samples)
                    place = (x0 * (one - b) + x1 * b) * (one - a) + (x2 * (one - b) + x3 * b) * a
                answer = distance(table, env, place - at)
                if sample >= 0:
                    deepest = wp.max(deepest, -answer[3])
                    bound = wp.max(bound, spacing - answer[3])
                elif answer[3] >= reach:
                    break
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
