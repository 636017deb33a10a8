# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Where each tip is after the next time step, and whether its environment takes that step."""

import functools

import warp as wp

from sim.fem.scalars import vector_of


@functools.cache
def tip_kernel(real):
    """Kernel that begins a time step, for one precision."""
    vec3 = vector_of(real)

    @wp.kernel(enable_backward=False, module="unique")
    def begin_step(
        # Schedule: corners [cells], and the steps after which the tip is there
        corners: wp.array2d(dtype=vec3),
        at: wp.array2d(dtype=wp.int32),
        settling: wp.array(dtype=real),
        # In:
        status: wp.array(dtype=wp.int32),
        # In and out: steps taken
        step: wp.array(dtype=wp.int32),
        # Out:
        active_out: wp.array(dtype=wp.int32),
        tip_out: wp.array(dtype=vec3),
        velocity_out: wp.array(dtype=vec3),
        damping_out: wp.array(dtype=real),
    ):
        env = wp.tid()
        last = at.shape[1] - 1
        now = step[env] + 1
        if status[env] != 0 or now > at[env, last]:
            active_out[env] = 0
            return
        active_out[env] = 1
        step[env] = now
        if now <= at[env, 0]:
            tip_out[env] = corners[env, 0]
            velocity_out[env] = vec3()
            damping_out[env] = settling[env]
            return
        segment = wp.int32(0)
        while segment < last - 1 and now > at[env, segment + 1]:
            segment += 1
        travel = corners[env, segment + 1] - corners[env, segment]
        steps = real(at[env, segment + 1] - at[env, segment])
        left = real(at[env, segment + 1] - now)
        tip_out[env] = corners[env, segment + 1] - travel * (left / steps)
        velocity_out[env] = travel / steps
        damping_out[env] = real(0.0)

    return begin_step
