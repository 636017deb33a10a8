"""Options that several commands share."""

import argparse
from pathlib import Path

from learning.indenters import UNSEEN
from recorder.command_line.options import names, names_or_none


def add_inputs(parser: argparse.ArgumentParser) -> None:
    """Add the inputs and the output folder of a training."""
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    add_split(parser)
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder of the run")


def add_split(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose which presses a training keeps for tests."""
    parser.add_argument(
        "--split",
        type=Path,
        metavar="JSON",
        help="split.json of another training (made: 10 %% of the presses of each seen indenter for "
        "validation, 10 %% and all of unseen indenters for tests)",
    )
    about = "indenters excluded from training, if a split is made (the archive's list; none: '')"
    parser.add_argument("--unseen", type=names_or_none, metavar="NAME,...", help=about)


def add_settings(
    parser: argparse.ArgumentParser,
    preset: str = "ours",
    known: str | None = None,
    example: str = "over the preset",
) -> None:
    """Add the options for a preset and for settings over it, with `known` and `example` as help."""
    about = known or f"name of a preset, or a YAML file ({preset})"
    parser.add_argument("--preset", default=preset, metavar="NAME", help=about)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=example)


def add_sensors(parser: argparse.ArgumentParser) -> None:
    """Add the option that chooses some of an archive's sensors."""
    about = "learn from these (all that are not held out)"
    parser.add_argument("--sensors", type=names, metavar="NAME,...", help=about)


def add_unseen(parser: argparse._ActionsContainer) -> None:
    """Add the option for held-out indenters."""
    parser.add_argument(
        "--unseen",
        type=names_or_none,
        default=UNSEEN,
        metavar="NAME,...",
        help=f"indenters excluded from training ({','.join(UNSEEN)}; none: '')",
    )


def named_number(text: str) -> tuple[str, float]:
    """Read NAME=NUMBER."""
    name, _, number = text.partition("=")
    try:
        return name, float(number)
    except ValueError:
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed: NAME=NUMBER") from None


def named_path(text: str) -> tuple[str, Path]:
    """Read NAME=PATH."""
    name, _, path = text.partition("=")
    if not name or not path:
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed: NAME=PATH")
    return name, Path(path)
