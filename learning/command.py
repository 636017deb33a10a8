"""Options that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path

from learning.errors import LearningError
from learning.indenters import UNSEEN


def add_inputs(parser: argparse.ArgumentParser) -> None:
    """Add the inputs and the output folder of a training."""
    parser.add_argument("archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr")
    parser.add_argument("--split", type=Path, required=True, metavar="JSON", help="of its presses")
    add_run(parser)


def add_run(parser: argparse.ArgumentParser) -> None:
    """Add the output folder of a training."""
    parser.add_argument("--out", type=Path, required=True, metavar="RUN", help="folder of the run")


def add_settings(
    parser: argparse.ArgumentParser,
    preset: str = "ours",
    known: str | None = None,
    example: str = "over the preset",
) -> None:
    """Add the options for a preset and for settings that override it.

    Args:
        parser: Parser of the command.
        preset: Name of the default preset.
        known: Help text of `--preset`; None: a general one.
        example: Help text of `--set`.
    """
    parser.add_argument(
        "--preset", default=preset, metavar="NAME", help=known or f"or a YAML file ({preset})"
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=example)


def add_sensors(parser: argparse.ArgumentParser) -> None:
    """Add the option that chooses some of an archive's sensors."""
    parser.add_argument(
        "--sensors", metavar="NAME,...", help="learn from these (all that are not held out)"
    )


def add_resume(
    parser: argparse.ArgumentParser, help_text: str = "continue the run in that folder"
) -> None:
    """Add the option that resumes a run."""
    parser.add_argument("--resume", action="store_true", help=help_text)


def add_unseen(parser: argparse.ArgumentParser) -> None:
    """Add the option for held-out indenters."""
    parser.add_argument(
        "--unseen",
        metavar="NAME,...",
        help=f"indenters excluded from training ({','.join(UNSEEN)}; none: '')",
    )


def unseen(listed: str | None) -> tuple[str, ...]:
    """Return the indenters that are held out."""
    return UNSEEN if listed is None else tuple(name for name in listed.split(",") if name)


def by_name(given: list[str] | None, option: str) -> dict[str, float]:
    """Parse numbers given as NAME=NUMBER.

    Raises:
        LearningError: A text is not of that form.
    """
    found = {}
    for text in given or []:
        name, _, number = text.partition("=")
        try:
            found[name] = float(number)
        except ValueError:
            raise LearningError(f"{option}: found {text!r}; allowed: NAME=NUMBER") from None
    return found
