"""`tactile archive join`: join sensors of several marker archives by place."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from learning.errors import LearningError
from recorder.command_line.options import add_value, names_or_none, positive
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from learning.data.matching import SensorSelection, Tolerances

# ARCHIVE:SENSOR=NAME,SENSOR after the last colon; an address such as s3://x has a slash there.
_WITH_SENSORS = re.compile(r"(?P<archive>.+):(?P<sensors>[^:/\\]+)")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Copies sensors of several archives into one and matches their presses, so that frames of "
        "two sensors can be paired. Two presses match if the same indenter touched the same place, "
        "to the same fraction of the sensor's deepest press, in the same shear direction; the "
        "numbers of the presses are ignored. Prints the number of matches of each two sensors, and "
        "why the other presses have none. Repeat a stopped command to continue it."
    )
    parser.add_argument(
        "archives",
        nargs="+",
        metavar="ARCHIVE[:SENSOR[=NAME],...]",
        help="X.markers.zarr: all of its sensors, or these, some under another name",
    )
    parser.add_argument("--out", type=Path, metavar="PATH", help="archive to write, X.markers.zarr")
    add_tolerances(parser)
    parser.add_argument(
        "--unseen",
        type=names_or_none,
        metavar="NAME,...",
        help="indenters excluded from training, '' for none (default: as in the archives)",
    )
    parser.add_argument("--dry-run", action="store_true", help="print the matches, write nothing")


def add_tolerances(parser: argparse.ArgumentParser) -> None:
    """Add the options for how far apart presses that match may be."""
    about = "largest distance between the places of matching presses [mm]"
    add_value(parser, "--place-mm", "MM", 0.1, about, positive)
    about = "largest difference of their depths, as fractions of the sensors' deepest"
    add_value(parser, "--depth-fraction", "FRACTION", 0.04, about, positive)
    about = "largest angle between their shear directions [deg]"
    add_value(parser, "--angle-deg", "DEG", 3.0, about, positive)


def tolerances_of(options: argparse.Namespace) -> Tolerances:
    """Return the tolerances of these options."""
    from learning.data.matching import Tolerances

    return Tolerances(
        1e-3 * options.place_mm, options.depth_fraction, math.radians(options.angle_deg)
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.data.join import join

    if options.out is None and not options.dry_run:
        raise LearningError("--out: missing; allowed: where the archive goes, or --dry-run")
    sensors = [each for text in options.archives for each in chosen_sensors(text)]
    joined = join(sensors, tolerances_of(options), options.unseen)
    for line in joined.lines():
        print(line)
    if options.dry_run:
        return 0
    with ItemProgress("frames", sys.stderr) as progress:
        copied = joined.write(options.out, progress)
    print(f"{options.out}: {copied:,} frames copied")
    return 0


def chosen_sensors(text: str) -> Iterator[SensorSelection]:
    """Yield the sensors that an argument names, in the order of their archive."""
    from learning.data.matching import SensorSelection
    from recorder import MarkerArchive

    named: dict[str, str] | None = None
    path, match = text, _WITH_SENSORS.fullmatch(text)
    if match is not None and not Path(text).exists():
        path = match["archive"]
        parts = (part.partition("=") for part in match["sensors"].split(","))
        named = {name: new or name for name, _, new in parts}
    archive = MarkerArchive(path)
    if archive.warning:
        raise LearningError(archive.warning)
    for name in named or archive:
        if name not in archive:
            raise LearningError(
                f"{archive.name}: has no sensor {name!r}; allowed: {', '.join(archive)}"
            )
        yield SensorSelection(archive, name, (named or {}).get(name, name))


def only_sensor(option: str, sensors: Sequence[SensorSelection]) -> SensorSelection:
    """Return the only one of the sensors that an option names; reject others."""
    if len(sensors) != 1:
        listed = ", ".join(each.sensor for each in sensors) or "none"
        raise LearningError(f"{option}: found sensors {listed}; allowed: one, ARCHIVE:SENSOR")
    return sensors[0]
