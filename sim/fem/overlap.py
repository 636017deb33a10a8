# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Overlap of skin and indenter, and of skin and base plane, measured by sampling.

The solver enforces contact at four points of a face. This kernel checks the points between them:
every face that can reach the indenter is sampled densely, at the end of a step and on the way to
it, where skin and tip are assumed to move straight. A signed distance changes by no more than the
distance that a point moves. So no point of a face is deeper than its deepest sample plus the
distance to the next one. Inside a wall a signed distance ends at half the wall's width; steps are
shorter than that, and a face that leaps further is sampled once for each of its own lengths.

Skin can only meet other skin where some of it has turned by a right angle or more. The kernel flags
faces that have nearly done so, and `sim.fem.self_overlap` then looks closer.

Lengths in thicknesses. One thread per face of each environment.
"""

import functools
import math

import warp as wp

from sim.indenters.device import PLAIN, Traits, distance_function, table_struct
from sim.scalars import vector_of

# Measured columns: deepest sample, upper bound of the depth, depth below the base plane, and 1 if
# a face is folded.
COLUMNS = 4
# Most states along a step at which a face is sampled.
STATES_MOST = 32
# Cosine of the angle to its rest normal below which a face counts as folded.
FOLDED = math.cos(math.radians(80))


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
        # Mesh:
        faces: wp.array2d(dtype=wp.int32),
        face_area: wp.array2d(dtype=real),
        nodes: wp.array2d(dtype=vec3),
        variant: wp.array(dtype=wp.int32),
        # Indenter:
        table: table_type,
        tip: wp.array(dtype=vec3),
        tip_old: wp.array(dtype=vec3),
        # In: samples along a side, and states along the step
        samples: int,
        states: int,
        active: wp.array(dtype=wp.int32),
        u: wp.array2d(dtype=vec3),
        u_old: wp.array2d(dtype=vec3),
        # Out: of each face (B, S, COLUMNS), and the largest of each environment (B, COLUMNS)
        face_out: wp.array3d(dtype=real),
        most_out: wp.array2d(dtype=real),
    ):
        env, s = wp.tid()
        if active[env] == 0:
            return
        m = variant[env]
        if face_area[m, s] == zero:  # outside a round body
            return
        deepest = zero
        bound = zero
        below = zero
        folded = zero
        n0 = faces[s, 0]
        n1 = faces[s, 1]
        n2 = faces[s, 2]
        n3 = faces[s, 3]
        travel = tip[env] - tip_old[env]
        d0 = u_old[env, n0] - u[env, n0]
        d1 = u_old[env, n1] - u[env, n1]
        d2 = u_old[env, n2] - u[env, n2]
        d3 = u_old[env, n3] - u[env, n3]
        first = nodes[m, n3] - nodes[m, n0]
        second = nodes[m, n2] - nodes[m, n1]
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
            at = tip[env] - travel * left
            x0 = nodes[m, n0] + u[env, n0] + d0 * left
            x1 = nodes[m, n1] + u[env, n1] + d1 * left
            x2 = nodes[m, n2] + u[env, n2] + d2 * left
            x3 = nodes[m, n3] + u[env, n3] + d3 * left
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
