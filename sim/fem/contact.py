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
        # Mesh:
        faces: wp.array2d(dtype=wp.int32),
        face_area: wp.array2d(dtype=real),
        shape: wp.array2d(dtype=real),
        rule: wp.array(dtype=real),
        nodes: wp.array2d(dtype=vec3),
        variant: wp.array(dtype=wp.int32),
        # Indenter:
        table: table_type,
        tip: wp.array(dtype=vec3),
        penalty: real,
        multiplier: wp.array3d(dtype=real),
        convex: wp.array(dtype=wp.int32),
        # Friction:
        coefficient: wp.array(dtype=real),
        stick: real,
        tip_old: wp.array(dtype=vec3),
        u_old: wp.array2d(dtype=vec3),
        traction_old: wp.array3d(dtype=vec3),
        limit: wp.array3d(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        # Out:
        force_out: wp.array3d(dtype=vec3),
        touched_out: wp.array2d(dtype=wp.int32),
        pressure_out: wp.array3d(dtype=real),
        normal_out: wp.array3d(dtype=vec3),
        traction_out: wp.array3d(dtype=vec3),
        matrix_out: wp.array3d(dtype=mat33),
        energy_out: wp.array2d(dtype=real),
    ):
        env, s = wp.tid()
        if active[env] == 0:
            return
        m = variant[env]
        if face_area[m, s] == zero:  # outside a round body
            return
        n0 = faces[s, 0]
        n1 = faces[s, 1]
        n2 = faces[s, 2]
        n3 = faces[s, 3]
        x0 = nodes[m, n0] + u[env, n0] - tip[env]
        x1 = nodes[m, n1] + u[env, n1] - tip[env]
        x2 = nodes[m, n2] + u[env, n2] - tip[env]
        x3 = nodes[m, n3] + u[env, n3] - tip[env]
        f0 = vec3()
        f1 = vec3()
        f2 = vec3()
        f3 = vec3()
        touched = int(0)
        energy = real(0.0)
        for p in range(rule.shape[0]):
            a0 = shape[p, 0]
            a1 = shape[p, 1]
            a2 = shape[p, 2]
            a3 = shape[p, 3]
            place = x0 * a0 + x1 * a1 + x2 * a2 + x3 * a3
            answer = distance(table, env, place)
            pressure = multiplier[env, s, p] - penalty * answer[3]
            if pressure > zero:
                touched += 1
                normal = vec3(answer[0], answer[1], answer[2])
                w = rule[p] * face_area[m, s]
                energy += half * w * pressure * pressure / penalty
                matrix = wp.outer(normal, normal) * penalty
                if convex[env] == 0:
                    matrix -= curvature(table, env, place, normal) * pressure
                traction = vec3()
                if wp.static(friction):
                    slip = (
                        (u[env, n0] - u_old[env, n0]) * a0
                        + (u[env, n1] - u_old[env, n1]) * a1
                        + (u[env, n2] - u_old[env, n2]) * a2
                        + (u[env, n3] - u_old[env, n3]) * a3
                        - (tip[env] - tip_old[env])
                    )
                    spring = stick * penalty
                    trial = traction_old[env, s, p] - slip * spring
                    trial = trial - normal * wp.dot(normal, trial)
                    size = wp.length(trial)
                    most = coefficient[env] * limit[env, s, p]
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
                    traction_out[env, s, p] = traction
                push = (normal * pressure + traction) * w
                normal_out[env, s, p] = normal
                matrix_out[env, s, p] = matrix * w
                f0 += push * a0
                f1 += push * a1
                f2 += push * a2
                f3 += push * a3
            else:
                pressure = zero
                matrix_out[env, s, p] = mat33()
                if wp.static(friction):
                    traction_out[env, s, p] = vec3()
            pressure_out[env, s, p] = pressure
        touched_out[env, s] = touched
        energy_out[env, s] = energy
        force_out[env, s, 0] = f0
        force_out[env, s, 1] = f1
        force_out[env, s, 2] = f2
        force_out[env, s, 3] = f3

    @wp.kernel(enable_backward=False, module="unique")
    def tangent(
        # Mesh:
        faces: wp.array2d(dtype=wp.int32),
        shape: wp.array2d(dtype=real),
        # In:
        active: wp.array(dtype=wp.int32),
        touched: wp.array2d(dtype=wp.int32),
        matrix: wp.array3d(dtype=mat33),
        v: wp.array2d(dtype=vec3),
        # Out: the derivative of -force, for faces that are touched
        force_out: wp.array3d(dtype=vec3),
    ):
        env, s = wp.tid()
        if active[env] == 0 or touched[env, s] == 0:
            return
        v0 = v[env, faces[s, 0]]
        v1 = v[env, faces[s, 1]]
        v2 = v[env, faces[s, 2]]
        v3 = v[env, faces[s, 3]]
        f0 = vec3()
        f1 = vec3()
        f2 = vec3()
        f3 = vec3()
        for p in range(shape.shape[0]):
            a0 = shape[p, 0]
            a1 = shape[p, 1]
            a2 = shape[p, 2]
            a3 = shape[p, 3]
            t = matrix[env, s, p] * (v0 * a0 + v1 * a1 + v2 * a2 + v3 * a3)
            f0 += t * a0
            f1 += t * a1
            f2 += t * a2
            f3 += t * a3
        force_out[env, s, 0] = f0
        force_out[env, s, 1] = f1
        force_out[env, s, 2] = f2
        force_out[env, s, 3] = f3

    return contact, tangent
