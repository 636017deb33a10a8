# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Reading of states: what a frame is made of, reduced on the device for all chosen environments.

One array comes to the host: a row for each environment, with the columns of `READ` and then the
nodes of the top. Sums are float64 and run in a fixed order; units are thicknesses and moduli.
"""

import functools

import numpy as np
import warp as wp

from sim.fem.overlap import COLUMNS as OVERLAPS
from sim.scalars import vector_of

READ = np.dtype(
    [
        ("force", float, 3),
        ("torque", float, 3),
        ("body", float, 3),
        ("energy", float),
        ("penetration", float),
        ("pressure", float),
        ("excess", float),
        ("overlap", float, OVERLAPS),
        ("face", float),
    ]
)
"""Sums: force of the indenter on the body, its torque about the tip, weight less inertia, energy of
the material at rest modulus, sticking springs and height (energy in penetration is left out:
penetration is an error, reported as `contact`). Greatest: penetration of a contact point, pressure,
and |shear| - coefficient * pressure, 0 at least. Then the columns of `sim.fem.overlap`, and the
face with the largest overlap, the first of several."""
COLUMNS = READ.itemsize // 8
# Columns of each node of the top: displacement and nodal force.
TOP = 6
SUMS, MAXIMA = 10, 3
FACE = COLUMNS - 1


@functools.cache
def reading_kernels(real, friction: bool, inertia: bool, gravity: bool, *, lanes: int = 1):
    """Return the kernels (read, top); `lanes` threads read an environment: 1, or a whole block."""
    vec3 = vector_of(real)
    sums_type = wp.types.vector(length=SUMS, dtype=wp.float64)
    maxima_type = wp.types.vector(length=MAXIMA, dtype=wp.float64)
    zero = wp.float64(0.0)

    @wp.kernel(enable_backward=False, module="unique")
    def read(
        # Mesh:
        faces: wp.array2d(dtype=wp.int32),
        face_area: wp.array2d(dtype=wp.float64),
        shape: wp.array2d(dtype=wp.float64),
        rule: wp.array(dtype=wp.float64),
        nodes: wp.array2d(dtype=wp.vec3d),
        node_volume: wp.array2d(dtype=wp.float64),
        variant: wp.array(dtype=wp.int32),
        # Contact: its stiffness and that of its sticking springs
        penalty: wp.float64,
        spring: wp.float64,
        coefficient: wp.array(dtype=wp.float64),
        multiplier: wp.array3d(dtype=real),
        # Inertia: mass over step squared, by environment, and positions of nodes without forces
        inertia_rate: wp.array(dtype=wp.float64),
        predicted: wp.array2d(dtype=vec3),
        # Gravity: weight of a unit volume, by environment
        weight: wp.array(dtype=vec3),
        # In:
        which: wp.array(dtype=wp.int32),
        tip: wp.array(dtype=wp.vec3d),
        u: wp.array2d(dtype=vec3),
        touched: wp.array2d(dtype=wp.int32),
        pressure: wp.array3d(dtype=real),
        normal: wp.array3d(dtype=vec3),
        traction: wp.array3d(dtype=vec3),
        element_energy: wp.array2d(dtype=real),
        face_overlap: wp.array3d(dtype=real),
        most_overlap: wp.array2d(dtype=real),
        # Out: `READ`
        row_out: wp.array2d(dtype=wp.float64),
    ):
        row, lane = wp.tid()
        env = which[row]
        m = variant[env]
        force = wp.vec3d()
        torque = wp.vec3d()
        body = wp.vec3d()
        energy = zero
        maxima = maxima_type()
        worst = zero
        face = int(faces.shape[0])
        for s in range(lane, faces.shape[0], lanes):
            overlap = wp.float64(face_overlap[env, s, 0])
            if overlap > worst or face == faces.shape[0]:
                worst = overlap
                face = s
            if touched[env, s] > 0:
                n0 = faces[s, 0]
                n1 = faces[s, 1]
                n2 = faces[s, 2]
                n3 = faces[s, 3]
                x0 = nodes[m, n0] + wp.vec3d(u[env, n0])
                x1 = nodes[m, n1] + wp.vec3d(u[env, n1])
                x2 = nodes[m, n2] + wp.vec3d(u[env, n2])
                x3 = nodes[m, n3] + wp.vec3d(u[env, n3])
                for p in range(rule.shape[0]):
                    here = wp.float64(pressure[env, s, p])
                    area = rule[p] * face_area[m, s]
                    push = wp.vec3d(normal[env, s, p]) * here
                    if wp.static(friction):
                        shear = wp.vec3d(traction[env, s, p])
                        push += shear
                        energy += wp.dot(shear, shear) * area / (wp.float64(2.0) * spring)
                        maxima[2] = wp.max(maxima[2], wp.length(shear) - coefficient[env] * here)
                    if here > zero:
                        deep = (here - wp.float64(multiplier[env, s, p])) / penalty
                        maxima[0] = wp.max(maxima[0], deep)
                        maxima[1] = wp.max(maxima[1], here)
                    place = (
                        x0 * shape[p, 0] + x1 * shape[p, 1] + x2 * shape[p, 2] + x3 * shape[p, 3]
                    )
                    push = push * area
                    force += push
                    torque += wp.cross(place - tip[env], push)
        for e in range(lane, element_energy.shape[1], lanes):
            energy += wp.float64(element_energy[env, e])
        if wp.static(gravity):
            for n in range(lane, nodes.shape[1], lanes):
                heavy = wp.vec3d(weight[env]) * node_volume[m, n]
                body += heavy
                energy -= wp.dot(heavy, wp.vec3d(u[env, n]))
        if wp.static(inertia):
            for n in range(lane, nodes.shape[1], lanes):
                ahead = wp.vec3d(u[env, n]) - wp.vec3d(predicted[env, n])
                body -= ahead * (node_volume[m, n] * inertia_rate[env])
        sums = sums_type()
        for axis in range(3):
            sums[axis] = force[axis]
            sums[3 + axis] = torque[axis]
            sums[6 + axis] = body[axis]
        sums[9] = energy
        if wp.static(lanes > 1):
            for column in range(SUMS):
                sums[column] = wp.tile_sum(wp.tile(sums[column]))[0]
            for column in range(MAXIMA):
                maxima[column] = wp.tile_max(wp.tile(maxima[column]))[0]
            most = wp.tile_max(wp.tile(worst))[0]
            if worst < most:
                face = faces.shape[0]
            face = wp.tile_min(wp.tile(face))[0]
        if lane == 0:
            for column in range(SUMS):
                row_out[row, column] = sums[column]
            for column in range(MAXIMA):
                row_out[row, SUMS + column] = maxima[column]
            for column in range(OVERLAPS):
                row_out[row, SUMS + MAXIMA + column] = wp.float64(most_overlap[env, column])
            row_out[row, FACE] = wp.float64(face)

    @wp.kernel(enable_backward=False, module="unique")
    def top(
        # Mesh: nodes of a column, and the number of faces of the top
        levels: int,
        top_faces: int,
        node_faces: wp.array2d(dtype=wp.int32),
        # In:
        which: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        touched: wp.array2d(dtype=wp.int32),
        face_force: wp.array3d(dtype=vec3),
        # Out: displacement and force of each node of the top, after `READ`
        row_out: wp.array2d(dtype=wp.float64),
    ):
        row, column = wp.tid()
        env = which[row]
        n = column * levels + levels - 1
        push = wp.vec3d()
        for k in range(4):
            place = node_faces[n, k]
            if place >= 0 and place // 4 < top_faces:
                if touched[env, place // 4] > 0:
                    push += wp.vec3d(face_force[env, place // 4, place % 4])
        for axis in range(3):
            row_out[row, COLUMNS + TOP * column + axis] = wp.float64(u[env, n][axis])
            row_out[row, COLUMNS + TOP * column + 3 + axis] = push[axis]

    return read, top
