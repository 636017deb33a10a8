# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""A grid node's time step: velocity from momentum, weight, the bonded base, the rigid indenter.

The base: inside the body the velocity field is extended below the base plane as an odd function, so
that a spline over nodes on both sides of it vanishes there. The first node below is bound to the
first above: they share one unknown, and its mass and momentum are gathered from both.
"""

import functools

import warp as wp

from sim.fem.scalars import vector_of
from sim.indenters.device import PLAIN, Traits, distance_function, table_struct
from sim.mpm.lattice import BASE_NODE
from sim.mpm.spline import FIXED_POINT

READINGS = 9
"""Impulses of a step: force of the indenter, its torque about the tip, force of the base."""
IMPULSE_UNIT = 2.0**40
"""Units of the integers in which these are summed up: one is 1e-12, the range is +-8 million."""


@functools.cache
def node_kernel(
    real, sticky: bool, friction: bool, gravity: bool, bonded: bool, traits: Traits = PLAIN
):
    """Kernel of a node's time step, for one precision, contact law, base and table's traits."""
    vec3 = vector_of(real)
    table_type = table_struct(real, traits)
    distance = distance_function(real, traits)
    zero, one, unit = real(0.0), real(1.0), real(FIXED_POINT)
    impulse_unit = real(IMPULSE_UNIT)
    base = BASE_NODE

    @wp.kernel(enable_backward=False, module="unique")
    def step_nodes(
        # Settings:
        nodes: wp.vec3i,
        corner: wp.vec3i,
        origin: vec3,
        reach: real,
        # Indenter:
        table: table_type,
        coefficient: wp.array(dtype=real),
        tip: wp.array(dtype=vec3),
        tip_velocity: wp.array(dtype=vec3),
        # Environments:
        active: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.int32),
        weight: wp.array(dtype=vec3),
        damping: wp.array(dtype=real),
        # In, and cleared for the next step:
        sums: wp.array3d(dtype=wp.int64),
        # Out:
        velocity_out: wp.array2d(dtype=vec3),
        history_out: wp.array3d(dtype=wp.int64),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        k = n % nodes[2]
        if wp.static(bonded) and k == base - 1:
            return
        # Where nothing came there is nothing to clear, and no particle reads the old velocity.
        some = sums[env, n, 0] | sums[env, n, 1] | sums[env, n, 2] | sums[env, n, 3]
        if some == wp.int64(0) and not (wp.static(bonded) and k == base + 1):
            return
        mass = real(sums[env, n, 0]) / unit
        px = real(sums[env, n, 1]) / unit
        py = real(sums[env, n, 2]) / unit
        pz = real(sums[env, n, 3]) / unit
        for c in range(4):
            sums[env, n, c] = wp.int64(0)
        momentum = vec3(px, py, pz)
        before = momentum
        below = zero
        if wp.static(bonded) and k == base + 1:
            below = real(sums[env, n - 2, 0]) / unit
            qx = real(sums[env, n - 2, 1]) / unit
            qy = real(sums[env, n - 2, 2]) / unit
            qz = real(sums[env, n - 2, 3]) / unit
            for c in range(4):
                sums[env, n - 2, c] = wp.int64(0)
            momentum -= vec3(qx, qy, qz)
            before += vec3(qx, qy, qz)
        v = vec3()
        slot = step[env] % history_out.shape[1]
        if mass + below > zero:
            v = momentum / (mass + below)
            if wp.static(gravity):
                # The bound pair falls as one with the upper node: their weights nearly cancel.
                v += weight[env] * ((mass - below) / (mass + below))
                before += weight[env] * (mass + below)
            v = v * (one - damping[env])
            pushed = vec3()
            if wp.static(bonded) and k <= base:
                v = vec3()
            else:
                i = n // (nodes[1] * nodes[2]) - corner[0]
                j = (n // nodes[2]) % nodes[1] - corner[1]
                place = vec3(real(i), real(j), real(k - corner[2]))
                lever = place - origin - tip[env]
                answer = distance(table, env, lever)
                if answer[3] < reach:
                    relative = v - tip_velocity[env]
                    change = vec3()
                    if wp.static(sticky):
                        change = -relative
                    else:
                        normal = vec3(answer[0], answer[1], answer[2])
                        approach = wp.dot(relative, normal)
                        if approach < zero:
                            change = -normal * approach
                            if wp.static(friction):
                                slip = relative - normal * approach
                                size = wp.length(slip)
                                most = -coefficient[env] * approach
                                if size <= most:
                                    change -= slip
                                else:
                                    change -= slip * (most / size)
                    v += change
                    pushed = change * (mass + below)
                    turned = wp.cross(lever, pushed)
                    for c in range(3):
                        wp.atomic_add(history_out, env, slot, c, wp.int64(pushed[c] * impulse_unit))
                        wp.atomic_add(
                            history_out, env, slot, 3 + c, wp.int64(turned[c] * impulse_unit)
                        )
            if wp.static(bonded) and k <= base + 1:
                held = v * (mass - below) - before - pushed
                for c in range(3):
                    wp.atomic_add(history_out, env, slot, 6 + c, wp.int64(held[c] * impulse_unit))
        velocity_out[env, n] = v
        if wp.static(bonded) and k == base + 1:
            velocity_out[env, n - 2] = -v

    return step_nodes
