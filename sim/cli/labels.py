"""`tactile sim labels`: forces of a sensor's twin in the presses of an archive."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from recorder.command_line.options import add_device, add_grid, add_seed, add_value, whole

if TYPE_CHECKING:
    from recorder.archive import MarkerArchive

# Largest height of a surface over where an archive has it [um].
HEIGHT_MOST = 1000.0
# Sensors drawn from a twin's uncertainty, and pixels along the longer side of a press.
DRAWS, GRID = 8, 64


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Simulates every press of a sensor of an archive with the sensor's twin (tactile twin "
        "fit), by the tier that it was fitted by: place, depth, direction and time are those of "
        "the archive, labels are not read. Adds the forces, and their spread over sensors drawn "
        "from the twin's uncertainty, to the archive. Done for two sensors, the method "
        "`simulated` of `tactile experiment` labels the frames of one for the other by them."
    )
    add = parser.add_argument
    add("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr, complete")
    add("--sensor", required=True, metavar="NAME", help="sensor of the archive")
    about = "its twin: a YAML file, or a row of sim/sensors"
    add("--twin", required=True, metavar="NAME", help=about)
    about = "sensors drawn for the spread; 0: none"
    add_value(parser, "--draws", "N", DRAWS, about, whole(0, 1000))
    add(
        "--height-um",
        type=float,
        metavar="UM",
        help="height of the surface over where the archive has it [um] (that of the twin's fit, "
        "which belongs to its quantities)",
    )
    add_seed(parser)
    add_grid(parser)
    add_device(parser)
    add_value(parser, "--processes", "N", 2, "processes", whole(1))


def run(options: argparse.Namespace) -> int:
    """Simulate, add the columns, and return the exit code."""
    from recorder.archive import MarkerArchive
    from sim.errors import SceneError

    height = None
    if options.height_um is not None:
        if not abs(options.height_um) <= HEIGHT_MOST:
            raise SceneError(
                f"--height-um: found {options.height_um:g}; allowed: up to {HEIGHT_MOST:g}, up or "
                "down"
            )
        height = 1e-6 * options.height_um
    add_forces(
        MarkerArchive(options.archive),
        options.sensor,
        options.twin,
        draws=options.draws,
        seed=options.seed,
        grid=options.grid,
        height=height,
        device=options.device,
        processes=options.processes,
    )
    return 0


def add_forces(
    archive: MarkerArchive,
    sensor: str,
    twin_name: str,
    *,
    draws: int = DRAWS,
    seed: int = 0,
    grid: int = GRID,
    height: float | None = None,
    device: str = "cpu",
    processes: int = 2,
) -> None:
    """Add the forces of a twin, a row or a YAML file, to a sensor of an archive, and say so.

    `height` is that of the surface over where the archive has it [m]; None: that of the twin's fit.
    """
    from recorder.archive import write_simulated
    from recorder.progress import Progress
    from sim.device import ready_device
    from sim.errors import SceneError
    from sim.sensors import sensor_of
    from sim.sensors.posterior import CERTAIN
    from sim.twin.labels import DEEP, provenance, simulated_forces

    ready_device(device)
    twin = sensor_of(twin_name)
    source = provenance(twin, draws, seed, grid, height)
    if sensor not in archive:
        raise SceneError(f"--sensor: {sensor!r}; allowed: {', '.join(archive)}")
    archived = archive[sensor]
    stored = archived.simulated
    if stored is not None and stored.made_from == source:
        print(f"{archive.path}: {sensor} has these forces already")
        return
    with Progress("labels", sys.stderr) as progress:
        simulated = simulated_forces(
            archived,
            archive.indenters,
            twin,
            draws=draws,
            seed=seed,
            grid=grid,
            height=height,
            device=device,
            processes=processes,
            progress=progress,
        )
    write_simulated(archived, simulated.force, simulated.spread, source)
    deepest = float(archived.table["depth"].max(initial=0.0)) / twin.body.thickness
    if deepest > DEEP and (twin.posterior or CERTAIN).tier == "layer":
        print(
            f"note: presses reach {100 * deepest:.0f} % of the thickness; from {100 * DEEP:.0f} % "
            "on, forces of tier layer are off by 5 % and more",
            file=sys.stderr,
        )
    if simulated.failed:
        print(
            f"note: {len(simulated.failed)} presses have no solution, and no force: "
            f"{simulated.failed[0]}",
            file=sys.stderr,
        )
    print(f"{archive.path}: forces of {source} added to {sensor}")
