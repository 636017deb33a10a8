"""The least that the iterations of a run can take: bytes to move, operations to do."""

from __future__ import annotations

import math
from dataclasses import dataclass

from benchmarks.sim.speed.record import Machine, Run
from sim.fem.numerics import ELASTIC_EVERY

# Bytes of a float32, and of a float16.
NUMBER, HALF = 4, 2
# Bytes of a vector and of a 3x3 matrix.
VECTOR, BLOCK = 3 * NUMBER, 9 * NUMBER
SLOTS = 27

# A node's row of the tangent, all of it stored.
ROW_BYTES = SLOTS * BLOCK
# The same as products read it on a GPU.
HALF_ROW_BYTES = SLOTS * 9 * HALF
# Pivot and coupling of a node, each read once.
PRECONDITIONER_BYTES = 2 * BLOCK
# Direction, product, solution and residual read, the two last and the preconditioned residual
# written; then that one and the direction read, and the direction written.
VECTORS_BYTES = 10 * VECTOR
# Of a node and iteration of conjugate gradients on a GPU; in the product a vector, which stays
# near, is read and one written.
CG_BYTES = HALF_ROW_BYTES + 2 * VECTOR + PRECONDITIONER_BYTES + VECTORS_BYTES
# The same where products read the tangent as it was assembled, as on a CPU.
WHOLE_CG_BYTES = CG_BYTES - HALF_ROW_BYTES + ROW_BYTES
# The product, three small products of the preconditioner, four vector updates and dot products.
CG_FLOPS = 2 * 9 * SLOTS + 3 * 18 + 2 * 15
# The elastic part read, the tangent written, its columns factored, displacement and residual;
# beside them the elastic part is written where it is new, and on a GPU the tangent in float16.
NEWTON_NODE_BYTES = 2 * ROW_BYTES + 4 * BLOCK + 4 * VECTOR
# Inverse Jacobians, weights and node numbers of an element.
_GEOMETRY_BYTES = 8 * BLOCK + 8 * NUMBER + 8 * NUMBER
# Forces of its corners, written and read.
_FORCES_BYTES = 2 * 8 * VECTOR
# Of an element's tangent and one evaluation of its forces, counted in the kernels' source; about 20
# % sure.
_TANGENT_FLOPS, _FORCES_FLOPS = 14_000, 3_500


def anew(*, cpu: bool) -> float:
    """Share of Newton iterations that assemble the elastic part."""
    return 1 / ELASTIC_EVERY if cpu else 1.0


def newton_element_bytes(*, cpu: bool) -> float:
    """Of a Newton iteration and element: what is read for the tangent and for the forces."""
    return (1 + anew(cpu=cpu)) * _GEOMETRY_BYTES + _FORCES_BYTES


def newton_element_flops(*, cpu: bool) -> float:
    """Operations of a Newton iteration and element."""
    return anew(cpu=cpu) * _TANGENT_FLOPS + _FORCES_FLOPS


@dataclass(frozen=True, slots=True)
class Floor:
    """What the iterations of a run ask for, and the seconds that takes at the machine's rates."""

    newton_bytes: float
    cg_bytes: float
    flops: float
    byte_seconds: float
    """At the rate of an array beyond any cache; on a CPU, at that of one press's tangent where it
    is higher."""
    flop_seconds: float

    @property
    def seconds(self) -> float:
        """The larger: moving and computing may go on at once."""
        known = [s for s in (self.byte_seconds, self.flop_seconds) if math.isfinite(s)]
        return max(known, default=math.nan)


def floor_of(run: Run, machine: Machine) -> Floor:
    """The floor of a run in float32, whose products read the tangent in float16 on a GPU."""
    cpu = machine.device == "cpu"
    of_node = NEWTON_NODE_BYTES + anew(cpu=cpu) * ROW_BYTES + (0 if cpu else HALF_ROW_BYTES)
    newton_bytes = run.newton_elements * newton_element_bytes(cpu=cpu) + run.newton_nodes * of_node
    cg_bytes = run.cg_nodes * (WHOLE_CG_BYTES if cpu else CG_BYTES)
    flops = run.newton_elements * newton_element_flops(cpu=cpu) + run.cg_nodes * CG_FLOPS
    rate = machine.copy_rate
    if cpu and machine.near_rate > rate:
        rate = machine.near_rate
    return Floor(
        newton_bytes=float(newton_bytes),
        cg_bytes=float(cg_bytes),
        flops=float(flops),
        byte_seconds=(newton_bytes + cg_bytes) / rate,
        flop_seconds=flops / machine.flop_rate,
    )
