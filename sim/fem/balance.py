# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Balance at the nodes: forces of elements and faces gathered, with forces that act on nodes.

Gathering (no atomic adds) makes every sum run in the same order, so that a result is repeatable
to the last bit. Sums are float64. On a CPU one thread handles `RUN` nodes and adds up its part;
on a GPU each handles one, and a block of `LANES` threads adds up theirs.
"""

import functools

import numpy as np
import warp as wp

from sim.device import kernel
from sim.fem.arrays import contact_struct, mesh_struct
from sim.fem.contact import OVERLAPS
from sim.scalars import vector_of

TOTALS = np.dtype(
    [
        ("square", float),
        ("applied", float),
        ("slope", float),
        ("det", float),
        ("contact", float, 3),
        ("base", float, 3),
    ]
)
"""Sums over a state: squares of the out-of-balance forces and of the nodal forces of contact and
weight, -(out-of-balance force) . direction; smallest determinant of the deformation gradient;
forces of the indenter, and of the base, on the body. Forces are in E T^2."""
SUMS = TOTALS.itemsize // 8
# The one that is a least value.
LEAST = 3
# Nodes of a partial sum: on a CPU, and on a GPU.
RUN, LANES = 32, 128


@functools.cache
def _nodal_function(real):
    """Return `nodal(mesh, contact, env, n)`: the force of the touched faces on a node."""
    vec3 = vector_of(real)

    @wp.func
    def nodal(mesh: mesh_struct(real), contact: contact_struct(real), env: int, n: int):
        total = vec3()
        for k in range(4):
            place = mesh.node_faces[n, k]
            if place >= 0:
                if contact.touched[env, place // 4] > 0:
                    total += contact.force[env, place // 4, place % 4]
        return total

    return nodal


@functools.cache
def residual_kernel(real, inertia: bool, gravity: bool, *, lanes: int = 1):
    """Return the kernel of the residual; `lanes` threads, 1 or a block, add up a partial sum."""
    vec3 = vector_of(real)
    own = RUN if lanes == 1 else 1
    sums_type = wp.types.vector(length=SUMS, dtype=wp.float64)
    nodal = _nodal_function(real)

    @kernel(block=LANES)
    def residual(
        mesh: mesh_struct(real),
        contact: contact_struct(real),
        # Inertia: mass over step squared, by environment, and positions of nodes without forces
        inertia_rate: wp.array(dtype=real),
        predicted: wp.array2d(dtype=vec3),
        # Damping: time over the step, by environment, and the elements' forces before it
        stiffer: wp.array(dtype=real),
        inner_old: wp.array2d(dtype=vec3),
        # Gravity: weight of a unit volume, by environment
        weight: wp.array(dtype=vec3),
        # In:
        active: wp.array(dtype=wp.int32),
        element_force: wp.array3d(dtype=vec3),
        element_det: wp.array2d(dtype=real),
        u: wp.array2d(dtype=vec3),
        direction: wp.array2d(dtype=vec3),
        # Out: the elements' forces, with inertia only; residual, and parts of `TOTALS`
        inner_out: wp.array2d(dtype=vec3),
        residual_out: wp.array2d(dtype=vec3),
        sums_out: wp.array3d(dtype=wp.float64),
    ):
        env, item = wp.tid()
        if active[env] == 0:
            return
        m = mesh.variant[env]
        sums = sums_type()
        lowest = real(1.0e30)
        for n in range(item * own, wp.min((item + 1) * own, mesh.free.shape[0])):
            inner = vec3()
            applied = nodal(mesh, contact, env, n)
            for k in range(8):
                place = mesh.node_elements[n, k]
                if place >= 0:
                    inner += element_force[env, place // 8, place % 8]
                    lowest = wp.min(lowest, element_det[env, place // 8])
            for axis in range(3):
                sums[4 + axis] += wp.float64(applied[axis])
            if wp.static(gravity):
                applied += weight[env] * mesh.mass[m, n]
            if wp.static(inertia):
                inner_out[env, n] = inner
                inner += (inner - inner_old[env, n]) * stiffer[env]
                inner += (u[env, n] - predicted[env, n]) * (inertia_rate[env] * mesh.inert[m, n])
            if mesh.free[n] == 0:
                for axis in range(3):
                    sums[7 + axis] += wp.float64(inner[axis] - applied[axis])
            r = (applied - inner) * real(mesh.free[n])
            applied = applied * real(mesh.free[n])
            residual_out[env, n] = r
            sums[0] += wp.float64(wp.dot(r, r))
            sums[1] += wp.float64(wp.dot(applied, applied))
            sums[2] -= wp.float64(wp.dot(r, direction[env, n]))
        sums[LEAST] = wp.float64(lowest)
        if wp.static(lanes > 1):
            for which in range(SUMS):
                if which == LEAST:
                    sums[which] = wp.tile_min(wp.tile(sums[which]))[0]
                else:
                    sums[which] = wp.tile_sum(wp.tile(sums[which]))[0]
        if item % lanes == 0:
            for which in range(SUMS):
                sums_out[env, item // lanes, which] = sums[which]

    return residual


@functools.cache
def push_kernel(real):
    """Return the kernel that writes the faces' forces on moving nodes in place of a residual."""
    nodal = _nodal_function(real)

    @kernel()
    def push(
        mesh: mesh_struct(real),
        contact: contact_struct(real),
        active: wp.array(dtype=wp.int32),
        residual_out: wp.array2d(dtype=vector_of(real)),
    ):
        env, n = wp.tid()
        if active[env] == 1:
            residual_out[env, n] = nodal(mesh, contact, env, n) * real(mesh.free[n])

    return push


@functools.cache
def work_kernel(real, friction: bool):
    """Return the kernel of the work at each face's contact points over a step (trapezoid rule).

    Pressure works over the displacement of the skin, friction over that of the indenter: a point
    that comes into contact within the step was not pushed before.
    """
    vec3 = vector_of(real)

    @kernel()
    def work(
        mesh: mesh_struct(real),
        # `push` is the pressure as a vector at the start of the step, and then at its end
        contact: contact_struct(real),
        # In: displacement and motion of the tip
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        step: wp.array(dtype=vec3),
        # Out:
        work_out: wp.array2d(dtype=real),
    ):
        env, s = wp.tid()
        if active[env] == 0:
            return
        total = real(0.0)
        for p in range(mesh.rule.shape[0]):
            way = vec3()
            for k in range(4):
                n = mesh.faces[s, k]
                way += (u[env, n] - contact.u_old[env, n]) * mesh.shape[p, k]
            push = contact.normal[env, s, p] * contact.pressure[env, s, p]
            at_point = wp.dot(contact.push[env, s, p] + push, way)
            if wp.static(friction):
                traction = contact.traction[env, s, p] + contact.traction_old[env, s, p]
                at_point += wp.dot(traction, step[env])
            contact.push[env, s, p] = push
            total += at_point * mesh.rule[p]
        work_out[env, s] = total * mesh.area[mesh.variant[env], s] * real(0.5)

    return work


@functools.cache
def reduce_kernel(*, lanes: int = 1):
    """Return the kernel that sums (B, runs, `SUMS`) by `lanes`; column `LEAST` takes the least."""

    @kernel(block=LANES)
    def reduce(
        # In:
        active: wp.array(dtype=wp.int32),
        sums: wp.array3d(dtype=wp.float64),
        # Out:
        totals_out: wp.array2d(dtype=wp.float64),
    ):
        env, which, lane = wp.tid()
        if active[env] == 0:
            return
        total = wp.float64(0.0)
        if which == LEAST:
            total = wp.float64(1.0e30)
        for run in range(lane, sums.shape[1], lanes):
            if which == LEAST:
                total = wp.min(total, sums[env, run, which])
            else:
                total += sums[env, run, which]
        if wp.static(lanes > 1):
            if which == LEAST:
                total = wp.tile_min(wp.tile(total))[0]
            else:
                total = wp.tile_sum(wp.tile(total))[0]
        if lane == 0:
            totals_out[env, which] = total

    return reduce


# Reading of states: what a frame is made of, reduced on the device for all chosen environments.
#
# One array comes to the host: a row for each environment, with the columns of `READ` and then the
# nodes of the top. Sums are float64 and run in a fixed order; units are thicknesses and moduli.

READ = np.dtype(
    [
        ("force", float, 3),
        ("torque", float, 3),
        ("body", float, 3),
        ("energy", float),
        ("sunk", float),
        ("pressure", float),
        ("excess", float),
        ("overlap", float, OVERLAPS),
        ("face", float),
    ]
)
"""Sums: force of the indenter on the body, its torque about the tip, weight less inertia, energy of
the material at rest modulus, sticking springs and height (energy in penetration is left out:
penetration is an error, reported as `contact`), and pressure times penetration, of either sign.
Greatest: pressure and |shear| - coefficient * pressure, 0 at least. Then `OVERLAPS`, and the face
with the largest overlap, the first of several."""
READ_COLUMNS = READ.itemsize // 8
# Columns of each node of the top: displacement and nodal force.
TOP = 6
READ_SUMS, MAXIMA = 11, 2
FACE = READ_COLUMNS - 1


@functools.cache
def reading_kernels(real, friction: bool, inertia: bool, gravity: bool, *, lanes: int = 1):
    """Return the kernels (read, top); `lanes` threads read an environment: 1, or a whole block."""
    vec3 = vector_of(real)
    sums_type = wp.types.vector(length=READ_SUMS, dtype=wp.float64)
    maxima_type = wp.types.vector(length=MAXIMA, dtype=wp.float64)
    zero = wp.float64(0.0)

    @kernel(block=LANES)
    def read(
        mesh: mesh_struct(wp.float64),
        contact: contact_struct(real),
        # Contact: its stiffness, that of its sticking springs, and friction, in float64
        penalty: wp.float64,
        spring: wp.float64,
        coefficient: wp.array(dtype=wp.float64),
        # Inertia: mass over step squared, by environment, and positions of nodes without forces
        inertia_rate: wp.array(dtype=wp.float64),
        predicted: wp.array2d(dtype=vec3),
        # Gravity: weight of a unit volume, by environment
        weight: wp.array(dtype=vec3),
        # In:
        which: wp.array(dtype=wp.int32),
        tip: wp.array(dtype=wp.vec3d),
        u: wp.array2d(dtype=vec3),
        element_energy: wp.array2d(dtype=real),
        face_overlap: wp.array3d(dtype=real),
        most_overlap: wp.array2d(dtype=real),
        # Out: `READ`
        row_out: wp.array2d(dtype=wp.float64),
    ):
        row, lane = wp.tid()
        env = which[row]
        m = mesh.variant[env]
        force = wp.vec3d()
        torque = wp.vec3d()
        body = wp.vec3d()
        energy = zero
        sunk = zero
        maxima = maxima_type()
        worst = zero
        face = int(mesh.faces.shape[0])
        for s in range(lane, mesh.faces.shape[0], lanes):
            overlap = wp.float64(face_overlap[env, s, 0])
            if overlap > worst or face == mesh.faces.shape[0]:
                worst = overlap
                face = s
            if contact.touched[env, s] > 0:
                n0 = mesh.faces[s, 0]
                n1 = mesh.faces[s, 1]
                n2 = mesh.faces[s, 2]
                n3 = mesh.faces[s, 3]
                x0 = mesh.nodes[m, n0] + wp.vec3d(u[env, n0])
                x1 = mesh.nodes[m, n1] + wp.vec3d(u[env, n1])
                x2 = mesh.nodes[m, n2] + wp.vec3d(u[env, n2])
                x3 = mesh.nodes[m, n3] + wp.vec3d(u[env, n3])
                for p in range(mesh.rule.shape[0]):
                    here = wp.float64(contact.pressure[env, s, p])
                    area = mesh.rule[p] * mesh.area[m, s]
                    push = wp.vec3d(contact.normal[env, s, p]) * here
                    if wp.static(friction):
                        shear = wp.vec3d(contact.traction[env, s, p])
                        push += shear
                        energy += wp.dot(shear, shear) * area / (wp.float64(2.0) * spring)
                        maxima[1] = wp.max(maxima[1], wp.length(shear) - coefficient[env] * here)
                    if here > zero:
                        deep = (here - wp.float64(contact.multiplier[env, s, p])) / penalty
                        sunk += wp.abs(deep) * here * area
                        maxima[0] = wp.max(maxima[0], here)
                    place = (
                        x0 * mesh.shape[p, 0]
                        + x1 * mesh.shape[p, 1]
                        + x2 * mesh.shape[p, 2]
                        + x3 * mesh.shape[p, 3]
                    )
                    push = push * area
                    force += push
                    torque += wp.cross(place - tip[env], push)
        for e in range(lane, element_energy.shape[1], lanes):
            energy += wp.float64(element_energy[env, e])
        if wp.static(gravity):
            for n in range(lane, mesh.nodes.shape[1], lanes):
                heavy = wp.vec3d(weight[env]) * mesh.mass[m, n]
                body += heavy
                energy -= wp.dot(heavy, wp.vec3d(u[env, n]))
        if wp.static(inertia):
            for n in range(lane, mesh.nodes.shape[1], lanes):
                ahead = wp.vec3d(u[env, n]) - wp.vec3d(predicted[env, n])
                body -= ahead * (mesh.inert[m, n] * inertia_rate[env])
        sums = sums_type()
        for axis in range(3):
            sums[axis] = force[axis]
            sums[3 + axis] = torque[axis]
            sums[6 + axis] = body[axis]
        sums[9] = energy
        sums[10] = sunk
        if wp.static(lanes > 1):
            for column in range(READ_SUMS):
                sums[column] = wp.tile_sum(wp.tile(sums[column]))[0]
            for column in range(MAXIMA):
                maxima[column] = wp.tile_max(wp.tile(maxima[column]))[0]
            most = wp.tile_max(wp.tile(worst))[0]
            if worst < most:
                face = mesh.faces.shape[0]
            face = wp.tile_min(wp.tile(face))[0]
        if lane == 0:
            for column in range(READ_SUMS):
                row_out[row, column] = sums[column]
            for column in range(MAXIMA):
                row_out[row, READ_SUMS + column] = maxima[column]
            for column in range(OVERLAPS):
                row_out[row, READ_SUMS + MAXIMA + column] = wp.float64(most_overlap[env, column])
            row_out[row, FACE] = wp.float64(face)

    @kernel()
    def top(
        # Mesh: nodes of a column, and the number of faces of the top
        levels: int,
        top_faces: int,
        mesh: mesh_struct(wp.float64),
        contact: contact_struct(real),
        # In:
        which: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        # Out: displacement and force of each node of the top, after `READ`
        row_out: wp.array2d(dtype=wp.float64),
    ):
        row, column = wp.tid()
        env = which[row]
        n = column * levels + levels - 1
        push = wp.vec3d()
        for k in range(4):
            place = mesh.node_faces[n, k]
            if place >= 0 and place // 4 < top_faces:
                if contact.touched[env, place // 4] > 0:
                    push += wp.vec3d(contact.force[env, place // 4, place % 4])
        for axis in range(3):
            row_out[row, READ_COLUMNS + TOP * column + axis] = wp.float64(u[env, n][axis])
            row_out[row, READ_COLUMNS + TOP * column + 3 + axis] = push[axis]

    return read, top
