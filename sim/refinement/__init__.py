"""How the force and the surface settle as the mesh gets finer: docs/refinement.md."""

from sim.refinement.bench import BenchRow, bench_rows
from sim.refinement.page import write_page
from sim.refinement.shapes import ShapeRow, shape_rows

__all__ = ["BenchRow", "ShapeRow", "bench_rows", "shape_rows", "write_page"]
