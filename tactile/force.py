"""`tactile force`: the choice of `learning`, and before it the forces of a twin by `sim`."""

import argparse

from learning.cli.archive_join import chosen_sensors, only_sensor
from learning.cli.force import add_options, make_model
from recorder.command_line.options import add_value, whole


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    about = (
        "twin of the sensor, a YAML file of `tactile twin fit`: its forces are added to the archive"
    )
    parser.add_argument("--twin", metavar="YAML", help=about)
    add_value(parser, "--processes", "N", 2, "processes that simulate the twin", whole(1))
    add_options(parser)


def run(options: argparse.Namespace) -> int:
    """Add the twin's forces if one is named, run the choice, and return the exit code."""
    if options.twin is not None and not options.explain:
        from sim.cli.labels import add_forces

        sensor = only_sensor("--sensor", [*chosen_sensors(options.sensor)])
        add_forces(
            sensor.archive,
            sensor.sensor,
            options.twin,
            device=options.device,
            processes=options.processes,
        )
    return make_model(options)
