"""`tactile sim labels`: forces of a sensor's twin in the presses of an archive."""

import argparse
import sys
from pathlib import Path

from recorder.command_line.options import add_device, add_grid, add_seed, add_value, whole

# Largest height of a surface over where an archive has it [um].
HEIGHT_MOST = 1000.0


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
    add(
        "--twin",
        required=True,
        metavar="NAME",
        help="its twin: a YAML file, or a row of sim/sensors",
    )
    about = "sensors drawn for the spread; 0: none"
    add_value(parser, "--draws", "N", 8, about, whole(0, 1000))
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
    from recorder.archive import MarkerArchive, write_simulated
    from recorder.progress import Progress
    from sim.device import ready_device
    from sim.errors import SceneError
    from sim.sensors import sensor_of
    from sim.sensors.posterior import CERTAIN
    from sim.twin.labels import DEEP, provenance, simulated_forces

    ready_device(options.device)
    twin = sensor_of(options.twin)
    height = None
    if options.height_um is not None:
        if not abs(options.height_um) <= HEIGHT_MOST:
            raise SceneError(
                f"--height-um: found {options.height_um:g}; allowed: up to {HEIGHT_MOST:g}, up or "
                "down"
            )
        height = 1e-6 * options.height_um
    source = provenance(twin, options.draws, options.seed, options.grid, height)
    archive = MarkerArchive(options.archive)
    if options.sensor not in archive:
        raise SceneError(f"--sensor: {options.sensor!r}; allowed: {', '.join(archive)}")
    archived = archive[options.sensor]
    stored = archived.simulated
    if stored is not None and stored.made_from == source:
        print(f"{options.archive}: {options.sensor} has these forces already")
        return 0
    with Progress("labels", sys.stderr) as progress:
        simulated = simulated_forces(
            archived,
            archive.indenters,
            twin,
            draws=options.draws,
            seed=options.seed,
            grid=options.grid,
            height=height,
            device=options.device,
            processes=options.processes,
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
    print(f"{options.archive}: forces of {source} added to {options.sensor}")
    return 0
