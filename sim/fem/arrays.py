# mypy: ignore-errors
# Warp gives kernels their types itself; mypy cannot follow annotations made at run time.
"""Arrays of a batch on the device: meshes, material and contact, vectors, and recorded launches.

B environments, on M meshes of one topology with E elements, N nodes and S faces; P points of
contact a face.
"""

import functools
import itertools
from collections.abc import Callable, Hashable, Sequence

import numpy as np
import warp as wp

from sim.device import kernel
from sim.fem.mesh import Mesh
from sim.scalars import PRECISIONS, matrix_of, numpy_of, vector_of


def array_of(values, dtype, real, device: str) -> wp.array:
    """Return values as an array of integers, of `real`, or of its vectors and matrices."""
    double = dict.fromkeys((wp.float64, wp.vec3d), np.float64)
    scalar = {wp.int32: np.int32, **double}.get(dtype, numpy_of(real))
    return wp.array(np.ascontiguousarray(values, dtype=scalar), dtype=dtype, device=device)


@functools.cache
def mesh_struct(real):
    """Return the struct of M meshes, as `mesh_on` makes it."""
    vec3, mat33 = vector_of(real), matrix_of(real)

    class DeviceMesh:
        variant: wp.array(dtype=wp.int32)  # mesh of each environment (B,)
        elements: wp.array2d(dtype=wp.int32)  # nodes of the corners (E, 8)
        inverse: wp.array3d(dtype=mat33)  # inverse Jacobians (M, E, 8); of boxes (M, E, 1).
        weight: wp.array3d(dtype=real)  # volumes of Gauss points (M, E, 8), 0 outside a body
        faces: wp.array2d(dtype=wp.int32)  # Nodes of the corners (S, 4)
        area: wp.array2d(dtype=real)  # of the faces (M, S), as `Mesh.face_area`
        shape: wp.array2d(dtype=real)  # shape functions at the points of contact (P, 4).
        rule: wp.array(dtype=real)  # weights of these points (P,)
        nodes: wp.array2d(dtype=vec3)  # rest positions (M, N)
        mass: wp.array2d(dtype=real)  # volume lumped to the nodes (M, N)
        inert: wp.array2d(dtype=real)  # the same for inertia: none at the top
        free: wp.array(dtype=wp.int32)  # 1 for nodes that move (N,)
        node_elements: wp.array2d(dtype=wp.int32)  # 8 e + corner around each node (N, 8), or -1
        node_faces: wp.array2d(dtype=wp.int32)  # 4 s + corner around each node (N, 4), or -1

    return wp.struct(DeviceMesh)


def mesh_on(
    device: str,
    meshes: Sequence[Mesh],
    variant,
    rule,
    real,
    *,
    elements: bool = True,
    inertia: bool = False,
) -> object:
    """Return the struct of meshes (M,) for environments (B,) on `variant` of them.

    `rule` has shape functions (P, 4) and weights (P,) of the points of contact. Without `elements`
    it has no Jacobians and weights.
    """

    def array(values, dtype=real):
        return array_of(values, dtype, real, device)

    first, struct = meshes[0], mesh_struct(real)()
    for name in ("elements", "faces", "free", "node_elements", "node_faces"):
        setattr(struct, name, array(getattr(first, name), wp.int32))
    struct.variant = array(variant, wp.int32)
    if elements:
        # Inverse Jacobians of boxes are equal at all Gauss points: one is kept of each element.
        boxes = all(mesh.inverse.strides[1] == 0 for mesh in meshes)
        inverses = [mesh.inverse[:, :1] if boxes else mesh.inverse for mesh in meshes]
        struct.inverse = array(inverses, matrix_of(real))
        struct.weight = array([each.weight for each in meshes])
    struct.area = array([each.face_area for each in meshes])
    struct.shape, struct.rule = array(rule[0]), array(rule[1])
    struct.nodes = array([each.nodes for each in meshes], vector_of(real))
    struct.mass = array([each.node_volume for each in meshes])
    struct.inert = array([each.inert_volume for each in meshes]) if inertia else struct.mass
    return struct


@functools.cache
def material_struct(real):
    """Return the struct of the material; moduli are over that of the body."""
    mat33 = matrix_of(real)

    class Material:
        shear: wp.array(dtype=real)  # moduli (B,)
        bulk: wp.array(dtype=real)
        factor: wp.array(dtype=real)  # on stress and on pressure (B,)
        bulk_factor: wp.array(dtype=real)
        history: wp.array3d(dtype=mat33)  # stress that does not change within a step (B, E, 8)
        bulk_history: wp.array2d(dtype=real)  # pressure that does not follow the volume (B, E)
        stiffening: wp.array(dtype=real)  # coefficient `Fem.stiffening` (B,)

    return wp.struct(Material)


@functools.cache
def contact_struct(real):
    """Return the struct of contact: its settings, and state by point (B, S, P) and by face."""
    vec3, mat33 = vector_of(real), matrix_of(real)

    class ContactState:
        penalty: real
        stick: real  # stiffness of sticking over the penalty
        coefficient: wp.array(dtype=real)  # of friction (B,)
        convex: wp.array(dtype=wp.int32)  # 1 to leave negative stiffness out (B,)
        tip: wp.array(dtype=vec3)  # of the indenter (B,), and at the last accepted step
        tip_old: wp.array(dtype=vec3)
        u_old: wp.array2d(dtype=vec3)  # displacement at the last accepted step (B, N)
        multiplier: wp.array3d(dtype=real)  # part of the pressure that needs no penetration
        pressure: wp.array3d(dtype=real)
        limit: wp.array3d(dtype=real)  # pressure that limits friction
        normal: wp.array3d(dtype=vec3)  # unit normal out of the indenter, where there is contact
        push: wp.array3d(dtype=vec3)  # pressure as a vector at the last accepted step
        traction: wp.array3d(dtype=vec3)  # shear on the body; no points without friction
        traction_old: wp.array3d(dtype=vec3)  # at the last accepted step
        matrix: wp.array3d(dtype=mat33)  # stiffness of each point
        touched: wp.array2d(dtype=wp.int32)  # number of touched points (B, S)
        energy: wp.array2d(dtype=real)  # of the springs (B, S)
        force: wp.array3d(dtype=vec3)  # on the corners (B, S, 4), where a face is touched

    return wp.struct(ContactState)


# Operations on vectors.


@functools.cache
def vector_kernels(real):
    """Return the kernels of one precision by name; those that copy by type and dimensions."""
    vec3 = vector_of(real)
    batched = kernel(group=f"sim.fem.arrays.{real.__name__}")

    def copy(dtype, dimensions: int):
        array = {2: wp.array2d, 3: wp.array3d}[dimensions]

        def copy_rows(
            active: wp.array(dtype=wp.int32),
            source: array(dtype=dtype),
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

        # Graphs on a CPU tell the kernels of a module by their names.
        copy_rows.__qualname__ += f"_{dimensions}_{int(dtype == vec3)}"
        return batched(copy_rows)

    @batched
    def fill(
        active: wp.array(dtype=wp.int32),
        value: wp.array(dtype=vec3),
        field_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 1:
            field_out[env, n] = value[env]

    @batched
    def step(
        active: wp.array(dtype=wp.int32),
        # True to step away from `other`, instead of along it
        away: bool,
        length: wp.array(dtype=real),
        start: wp.array2d(dtype=vec3),
        other: wp.array2d(dtype=vec3),
        step_out: wp.array2d(dtype=vec3),
    ):
        env, n = wp.tid()
        if active[env] == 0:
            return
        direction = other[env, n]
        if away:
            direction = start[env, n] - direction
        step_out[env, n] = start[env, n] + direction * length[env]

    @batched
    def blend(
        active: wp.array(dtype=wp.int32),
        fraction: real,
        source: wp.array3d(dtype=real),
        mean_out: wp.array3d(dtype=real),
    ):
        env, i = wp.tid()
        if active[env] == 0:
            return
        for j in range(source.shape[2]):
            mean_out[env, i, j] = mean_out[env, i, j] + fraction * (
                source[env, i, j] - mean_out[env, i, j]
            )

    copies = {of: copy(*of) for of in itertools.product((real, vec3), (2, 3))}
    return {**copies, "fill": fill, "step": step, "blend": blend}


def _launch(name: Hashable, inputs, out) -> None:
    real = next(one for one in PRECISIONS.values() if out.dtype in (one, vector_of(one)))
    one = vector_kernels(real)[name]
    wp.launch(one, dim=out.shape[:2], inputs=inputs, outputs=[out], device=out.device)


def copy_active(active, source, out) -> None:
    """Copy the rows of active environments, arrays of (B, n) or (B, n, m)."""
    _launch((out.dtype, out.ndim), [active, source], out)


def fill(active, value, out) -> None:
    """Write the vector `value` of each active environment (B,) everywhere in its row (B, N)."""
    _launch("fill", [active, value], out)


def axpy(active, length, start, direction, out) -> None:
    """Write out = start + length * direction where active; vectors (B, N), length (B,)."""
    _launch("step", [active, False, length, start, direction], out)


def extrapolate(active, fraction, now, before, out) -> None:
    """Write out = now + fraction * (now - before) where active; vectors (B, N), fraction (B,)."""
    _launch("step", [active, True, fraction, now, before], out)


def blend(active, fraction: float, source, mean) -> None:
    """Move `mean` by `fraction` of the way to `source` where active; numbers (B, n, m)."""
    _launch("blend", [active, fraction, source], mean)


class Graphs:
    """Launches of one device that are repeated with the same arrays, recorded as graphs.

    To launch a kernel costs Python 50 us or more, a graph of many of them about as much as one.
    Without `record` they are launched one by one.
    """

    def __init__(self, device, *, record: bool = True) -> None:
        self._device, self._records = device, record
        self._graphs = {}

    def repeat(self, launches: Callable[..., None], *arguments, key: tuple[int, ...] = ()) -> None:
        """Call `launches`, a method that launches kernels and does nothing else, or its graph.

        It depends on no more than `key`, the addresses of the arrays among the arguments, and the
        others. It is recorded the second time: the first time may compile kernels, which a
        recording must not.
        """
        key = launches.__name__, *key, *(getattr(one, "ptr", one) for one in arguments)
        graph = self._graphs.get(key)
        if graph is None:
            if not self._records or key not in self._graphs:
                self._graphs[key] = None
                launches(*arguments)
                return
            with wp.ScopedCapture(self._device) as capture:
                launches(*arguments)
            graph = self._graphs[key] = capture.graph
        wp.capture_launch(graph)
