"""`tactile calibrate-force`: the scale of a transferred model, by weights laid on the sensor."""

import argparse
import re
from pathlib import Path

from learning.errors import LearningError
from recorder.command_line.options import add_value, positive

_WEIGHT = re.compile(r"(?P<value>[0-9.]+)\s*(?P<unit>g|kg)")
GRAVITY = 9.80665


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Sets the scale of a model that `tactile force` made. Lay weights on the sensor "
        "one after another, in the order of --weights, and lift each off, while `tactile live "
        "--model MODEL --out holds.csv` runs; each hold of contact is one weight. Or name frames "
        "of an archive, in which a weight rests: --archive with --rows."
    )
    add = parser.add_argument
    add("model", type=Path, metavar="MODEL", help="of `tactile force`")
    about = "masses, in the order in which they were laid on"
    add("--weights", type=weights, required=True, metavar="50g,100g,...", help=about)
    about = "mass of what each of them stands on (0g)"
    add("--carrier", type=weights, default=[0.0], metavar="20g", help=about)
    add_value(parser, "--gravity", "M/S2", GRAVITY, "where they are laid on [m/s^2]", positive)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--holds", type=Path, metavar="CSV", help="written by live --out")
    source.add_argument("--archive", metavar="ARCHIVE:SENSOR", help="X.markers.zarr")
    add("--rows", metavar="N,...", help="rows of the archive's table, one for each weight")
    add("--out", type=Path, required=True, metavar="MODEL", help="folder of the scaled model")


def weights(text: str) -> list[float]:
    """Return masses [kg]."""
    masses = []
    for each in text.split(","):
        match = _WEIGHT.fullmatch(each.strip())
        value = float(match["value"]) if match and match["value"].count(".") < 2 else 0.0
        if match is None or value <= 0:
            raise argparse.ArgumentTypeError(f"found {each!r}; allowed: masses as 50g or 0.2kg")
        masses.append(value * (1e-3 if match["unit"] == "g" else 1.0))
    return masses


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from learning.transfer.scale import forces_of_holds, forces_of_rows, weigh

    if options.out.exists():
        raise LearningError(f"--out: found {options.out}; allowed: a new folder")
    if (options.archive is None) != (options.rows is None):
        raise LearningError("--rows: goes with --archive, and --archive with it; allowed: both")
    if len(options.carrier) != 1:
        raise LearningError(f"--carrier: found {len(options.carrier)} masses; allowed: one")
    masses = [mass + options.carrier[0] for mass in options.weights]
    if options.holds is not None:
        predicted = forces_of_holds(options.holds, len(masses))
    else:
        predicted = forces_of_rows(options.model, options.archive, _rows(options.rows))
    loads = [options.gravity * mass for mass in masses]
    for line in weigh(options.model, options.out, loads, predicted):
        print(line)
    return 0


def _rows(text: str) -> list[int]:
    try:
        return [int(each) for each in text.split(",")]
    except ValueError:
        raise LearningError(f"--rows: found {text!r}; allowed: whole numbers, N,N,...") from None
