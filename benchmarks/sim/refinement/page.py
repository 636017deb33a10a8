"""Write docs/results/refinement.md: tables of the bench problem and of the 18 shapes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.sim.refinement.bench import FAR, BenchRow, convergence_rate
from benchmarks.sim.refinement.shapes import DEPTH, FRICTION, SHEAR, ShapeRow
from recorder.pages import render
from sim.fem import Fem


def write_page(
    path: Path,
    device: str,
    bench: Sequence[BenchRow],
    shapes: Sequence[tuple[float, float, Sequence[ShapeRow]]],
) -> None:
    """Write the page; an empty part is skipped."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        render(
            Path(__file__).with_suffix(".md"),
            device=device,
            bench=sorted(bench, key=lambda row: -row.spacing),
            convergence_rate=convergence_rate,
            shapes=shapes,
            by_shape=list(zip(*(rows for _, _, rows in shapes), strict=True)),
            numerics=Fem(),
            far=FAR,
            depth=DEPTH,
            shear=SHEAR,
            friction=FRICTION,
        )
    )
