"""Convergence of force and surface with mesh refinement: docs/results/refinement.md."""

from benchmarks.sim.refinement.bench import BenchRow, bench_rows
from benchmarks.sim.refinement.page import write_page
from benchmarks.sim.refinement.shapes import ShapeRow, shape_rows

__all__ = ["BenchRow", "ShapeRow", "bench_rows", "shape_rows", "write_page"]
