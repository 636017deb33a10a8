"""Write docs/results/refinement.md: tables of the bench problem and of the 18 shapes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.sim.refinement.bench import FAR, BenchRow, convergence_rate
from benchmarks.sim.refinement.shapes import DEPTH, FRICTION, SHEAR, ShapeRow
from sim.fem.numerics import Fem

MM = 1e3


def write_page(
    path: Path,
    device: str,
    bench: Sequence[BenchRow],
    shapes: Sequence[tuple[float, float, Sequence[ShapeRow]]],
) -> None:
    """Write the page; an empty part is skipped."""
    lines = ["# Mesh refinement", ""]
    lines.append(
        "Results of the `fem` tier on a series of meshes. Made by "
        f"`python -m benchmarks refine`, on {device}."
    )
    if bench:
        lines += ["", *_bench_lines(bench)]
    if shapes:
        lines += ["", *_shape_lines(shapes)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def _bench_lines(rows: Sequence[BenchRow]) -> list[str]:
    rows = sorted(rows, key=lambda row: -row.spacing)
    numerics = Fem()
    lines = [
        "## Sphere, compared with converged values",
        "",
        "R 4 mm into 20x20x4 mm, E 0.145 MPa, nu 0.45, no friction; against 0.2652, 0.9197, "
        "1.9560 N at 0.5, 1.0, 1.5 mm, on which two",
        "element families agree to 0.1 %. Surface: largest difference from that reference's "
        "heights and outward shifts at 3 to 8 mm from the",
        f"axis, and from the finest mesh everywhere beyond {FAR * MM:g} mm. Contact stiffness "
        f"{numerics.penalty:g} E/T, tolerance {numerics.tolerance:g}. Seconds are wall",
        "time on a machine that may be shared.",
        "",
        "| element | mesh | F at 0.5, 1.0, 1.5 mm | error | surface | to the finest | Newton, CG "
        "| seconds |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        force = " ".join(f"{value:.4f}" for value in row.force)
        error = " ".join(f"{100 * value:+.2f}" for value in row.error)
        lines.append(
            f"| {row.spacing * MM:.3g} mm | {'x'.join(map(str, row.cells))} | {force} N "
            f"| {error} % | {row.field_error * 1e6:.1f} um | {row.finest_error * 1e6:.1f} um "
            f"| {row.newton}, {row.cg} | {row.seconds:.2f} |"
        )
    if len(rows) > 2:
        lines += [
            "",
            f"The force converges as (element size)^{convergence_rate(rows):.1f}, fitted to "
            "the mean error over the depths against the finest mesh.",
        ]
    return lines


def _shape_lines(parts: Sequence[tuple[float, float, Sequence[ShapeRow]]]) -> list[str]:
    spacings = [spacing for spacing, _seconds, _rows in parts]
    columns = [f"{spacing * MM:.3g} mm" for spacing in spacings]
    lines = [
        "## The 18 indenters",
        "",
        f"Pressed to {DEPTH * MM:g} mm and sheared by {SHEAR * MM:g} mm along x, friction "
        f"{FRICTION:g}, all in one batch. Fz pressed and Fx sheared [N] for each element size;",
        "the change is that of Fz from the second finest mesh to the finest. Seconds for the "
        "batch: "
        + ", ".join(
            f"{seconds:.0f} at {c}" for (_, seconds, _), c in zip(parts, columns, strict=True)
        )
        + ".",
        "",
        "| shape | edge radius | "
        + " | ".join(f"Fz, Fx at {c}" for c in columns)
        + " | change | min det F | balance |",
        "|---|---|" + "---|" * len(columns) + "---|---|---|",
    ]
    for index, first in enumerate(parts[0][2]):
        rows = [part[2][index] for part in parts]
        cells = [
            "no solution" if row.diverged else f"{row.pressed:.3f}, {row.sheared:.3f}"
            for row in rows
        ]
        change = "-"
        if len(rows) > 1 and not (rows[-1].diverged or rows[-2].diverged):
            change = f"{100 * (rows[-1].pressed / rows[-2].pressed - 1):+.1f} %"
        edge = f"{first.edge_radius * MM:g} mm" if first.edge_radius else "none"
        lines.append(
            f"| {first.name} | {edge} | "
            + " | ".join(cells)
            + f" | {change} | {rows[-1].det_f_min:.2f} | {rows[-1].balance:.0e} |"
        )
    return lines
