# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Small vector operations on a batch."""

import functools

import warp as wp


@functools.cache
def _copy_kernel(dtype, dimensions):
    array = {2: wp.array2d, 3: wp.array3d}[dimensions]

    @wp.kernel(enable_backward=False, module="unique")
    def copy_rows(
        # In:
        active: wp.array(dtype=wp.int32),
        source: array(dtype=dtype),
        # Out:
        copy_out: array(dtype=dtype),
    ):
        env, i = wp.tid()
        if active[env] == 0:
            return
        if wp.static(dimensions == 2):
            copy_out[env, i] = source[env, i]
        else:
            for j in range(source.shape[2]):
                copy_out[env, i, j] = source[env, i, j]

    return copy_rows


def copy_active(active, source, out) -> None:
    """Copy the rows of active environments, arrays of (B, n) or (B, n, m)."""
    wp.launch(
        _copy_kernel(source.dtype, source.ndim),
        dim=source.shape[:2],
        inputs=[active, source],
        outputs=[out],
        device=source.device,
    )


@functools.cache
def _fill_kernel(vec3):
    @wp.kernel(enable_backward=False, module="unique")
    def fill(
        # In:
        active: wp.array(dtype=wp.int32),
        value: wp.array(dtype=vec3),
        # Out:
        field_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        field_out[env, n] = value[env]

    return fill


def fill(active, value, out) -> None:
    """Write the vector `value` of each active environment (B,) everywhere in its row (B, N)."""
    wp.launch(
        _fill_kernel(out.dtype),
        dim=out.shape,
        inputs=[active, value],
        outputs=[out],
        device=out.device,
    )


@functools.cache
def _extrapolate_kernel(real, vec3):
    @wp.kernel(enable_backward=False, module="unique")
    def extrapolate(
        # In:
        active: wp.array(dtype=wp.int32),
        share: wp.array(dtype=real),
        now: wp.array2d(dtype=vec3),
        before: wp.array2d(dtype=vec3),
        # Out:
        guess_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        guess_out[env, n] = now[env, n] + (now[env, n] - before[env, n]) * share[env]

    return extrapolate


def extrapolate(active, share, now, before, out) -> None:
    """Write out = now + share * (now - before) where active; vectors (B, N), share (B,)."""
    wp.launch(
        _extrapolate_kernel(share.dtype, now.dtype),
        dim=now.shape,
        inputs=[active, share, now, before],
        outputs=[out],
        device=now.device,
    )


@functools.cache
def _walk_kernel(real, vec3):
    @wp.kernel(enable_backward=False, module="unique")
    def walk(
        # In:
        active: wp.array(dtype=wp.int32),
        length: wp.array(dtype=real),
        start: wp.array2d(dtype=vec3),
        direction: wp.array2d(dtype=vec3),
        # Out:
        u_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        u_out[env, n] = start[env, n] + direction[env, n] * length[env]

    return walk


def walk(active, length, start, direction, out) -> None:
    """Write out = start + length * direction where active; vectors (B, N), length (B,)."""
    wp.launch(
        _walk_kernel(length.dtype, start.dtype),
        dim=start.shape,
        inputs=[active, length, start, direction],
        outputs=[out],
        device=start.device,
    )


@functools.cache
def _blend_kernel(real):
    @wp.kernel(enable_backward=False, module="unique")
    def blend(
        # In:
        active: wp.array(dtype=wp.int32),
        share: real,
        source: wp.array3d(dtype=real),
        # In and out:
        mean_out: wp.array3d(dtype=real),
    ):
        env, i = wp.tid()
        if active[env] == 0:
            return
        for j in range(source.shape[2]):
            mean_out[env, i, j] = mean_out[env, i, j] + share * (
                source[env, i, j] - mean_out[env, i, j]
            )

    return blend


def blend(active, share: float, source, mean) -> None:
    """Move `mean` by `share` of the way to `source` where active; numbers (B, n, m)."""
    wp.launch(
        _blend_kernel(source.dtype),
        dim=source.shape[:2],
        inputs=[active, share, source],
        outputs=[mean],
        device=source.device,
    )
