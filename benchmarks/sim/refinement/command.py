"""Force and surface against element size.

`python -m benchmarks refine` writes docs/results/refinement.md.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from recorder.command_line.options import add_device, numbers
from sim.cli.options import MM


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "--bench",
        type=numbers(),
        default=(1.25, 1.0, 0.8, 0.6667, 0.5, 0.4),
        metavar="MM,...",
        help="element sizes for the bench problem [mm] (%(default)s); the finest takes "
        "minutes on a CPU",
    )
    parser.add_argument(
        "--shapes",
        type=numbers(),
        default=(1.0, 0.8, 0.6667),
        metavar="MM,...",
        help="element sizes for the 18 shapes [mm] (%(default)s); half an hour each on a CPU",
    )
    parser.add_argument("--only", choices=("bench", "shapes"), help="run this part only")
    add_device(parser)
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("docs/results/refinement.md"),
        help="page to write (%(default)s)",
    )


def run(options: argparse.Namespace) -> int:
    """Solve, print results as they come, write the page, and return the exit code.

    Raises:
        SceneError: A mesh that cannot be built, or an unknown device.
        SimulationDiverged: The bench problem was not solved.
    """
    from benchmarks.sim.refinement.bench import bench_rows
    from benchmarks.sim.refinement.page import write_page
    from benchmarks.sim.refinement.shapes import shape_rows
    from sim.device import ready_device

    ready_device(options.device)
    bench, shapes = [], []
    if options.only != "shapes":
        for row in bench_rows([size * MM for size in options.bench], options.device):
            bench.append(row)
            error = " ".join(f"{100 * value:+.2f}" for value in row.error)
            print(f"{row.spacing / MM:.3g} mm: {error} %, {row.seconds:.1f} s", file=sys.stderr)
    if options.only != "bench":
        sizes = sorted((size * MM for size in options.shapes), reverse=True)
        for spacing, seconds, rows in shape_rows(sizes, options.device):
            shapes.append((spacing, seconds, rows))
            failed = [shape.name for shape in rows if shape.diverged]
            message = f"no solution for {', '.join(failed)}" if failed else "all solved"
            print(f"{spacing / MM:.3g} mm, shapes: {message}, {seconds:.0f} s", file=sys.stderr)
            for shape in rows:
                if shape.diverged:
                    print(f"  {shape.name}: {shape.diverged}", file=sys.stderr)
    write_page(options.out, options.device, bench, shapes)
    print(f"{options.out}: written")
    return int(any(shape.diverged for _, _, rows in shapes for shape in rows))
