"""Roofline bound on the time of a run's iterations: memory traffic and operations."""

from __future__ import annotations

import math
from dataclasses import dataclass

from benchmarks.sim.speed.record import Machine, Run

# Bytes of a float32, and of a float16.
NUMBER, HALF = 4, 2
# Bytes of a vector and of a 3x3 matrix.
VECTOR, BLOCK = 3 * NUMBER, 9 * NUMBER
SLOTS = 27

# Full row of a node in the tangent.
ROW_BYTES = SLOTS * BLOCK
# The same as read by matrix-vector products on a GPU.
HALF_ROW_BYTES = SLOTS * 9 * HALF
# Pivot and coupling blocks of a node, each read once.
PRECONDITIONER_BYTES = 2 * BLOCK
# Search direction, product, solution and residual read, the last two and the preconditioned
# residual written; then that residual and the direction read, and the direction written.
VECTORS_BYTES = 10 * VECTOR
# Per node and iteration of conjugate gradients with products in float16; in the product one vector,
# which stays in cache, is read and one written.
CG_BYTES = HALF_ROW_BYTES + 2 * VECTOR + PRECONDITIONER_BYTES + VECTORS_BYTES
# The same with products that read the tangent as it was assembled, as on a CPU.
WHOLE_CG_BYTES = CG_BYTES - HALF_ROW_BYTES + ROW_BYTES
# Operations of the product, three small products of the preconditioner, four vector updates and
# dot products.
CG_FLOPS = 2 * 9 * SLOTS + 3 * 18 + 2 * 15
# Tangent cleared, elements and contact added to it, its columns factored, displacement and
# residual; on a GPU the tangent is also written in float16.
NEWTON_NODE_BYTES = 3 * ROW_BYTES + 4 * BLOCK + 4 * VECTOR
# Inverse Jacobians, weights and node numbers of an element.
_GEOMETRY_BYTES = 8 * BLOCK + 8 * NUMBER + 8 * NUMBER
# Bytes of a Newton iteration and element: geometry read for the tangent and for the forces; forces
# at its corners written and read.
NEWTON_ELEMENT_BYTES = 2 * _GEOMETRY_BYTES + 2 * 8 * VECTOR
# Operations for an element's tangent and for its forces, counted in the kernels' source, accurate
# to about 20 %.
NEWTON_ELEMENT_FLOPS = 14_000 + 3_500


@dataclass(frozen=True, slots=True)
class Floor:
    """Memory traffic and operations of a run, and their time at the machine's rates."""

    newton_bytes: float
    cg_bytes: float
    flops: float
    byte_seconds: float
    """At the copy rate of an array beyond any cache, or, on a CPU, of one press's tangent if that
    is faster."""
    flop_seconds: float

    @property
    def seconds(self) -> float:
        """The larger of both times, since memory traffic and computation can overlap."""
        known = [s for s in (self.byte_seconds, self.flop_seconds) if math.isfinite(s)]
        return max(known, default=math.nan)


def bound_of(run: Run, machine: Machine, *, half: bool) -> Floor:
    """Return the bound for a run in float32; `half`: products read the tangent in float16."""
    of_node = NEWTON_NODE_BYTES + (HALF_ROW_BYTES if half else 0)
    newton_bytes = run.newton_elements * NEWTON_ELEMENT_BYTES + run.newton_nodes * of_node
    cg_bytes = run.cg_nodes * (CG_BYTES if half else WHOLE_CG_BYTES)
    flops = run.newton_elements * NEWTON_ELEMENT_FLOPS + run.cg_nodes * CG_FLOPS
    rate = machine.copy_rate
    if machine.device == "cpu" and machine.near_rate > rate:
        rate = machine.near_rate
    return Floor(
        newton_bytes=float(newton_bytes),
        cg_bytes=float(cg_bytes),
        flops=float(flops),
        byte_seconds=(newton_bytes + cg_bytes) / rate,
        flop_seconds=flops / machine.flop_rate,
    )
