"""`python -m recorder import`: convert a recording made elsewhere into a session."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from recorder.cli.options import add_session
from recorder.convert import ImportRequest, import_session
from recorder.convert.import_force import FORCE_UNITS, TORQUE_UNITS
from recorder.convert.import_taxels import ORDERS
from recorder.errors import SessionError
from recorder.progress import ItemProgress

Value = TypeVar("Value")

_NAME = re.compile("[A-Za-z][A-Za-z0-9_]*")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_session(parser)
    add = parser.add_argument
    several: dict[str, Any] = {"action": "append", "default": [], "metavar": "[NAME=]PATH"}
    rates: dict[str, Any] = {"action": "append", "default": [], "metavar": "[NAME=]HZ"}
    add("--video", **several, help="video file, or folder of images in name order")
    add("--force", **several, help="forces: .csv with a header, or .npy")
    add("--taxels", **several, help="taxel counts: .npy (n, 48), (n, 16, 3) or (n, 3, 16)")
    add("--sensor", required=True, help="name of the sensor")
    add("--indenter", required=True, help="name of what touched it")
    add("--operator", default="", help="who recorded it")
    add("--fps", **rates, help="images per second (default: as the video says)")
    add("--force-hz", **rates, help="force rows per second, without a time column")
    add("--taxels-hz", **rates, help="taxel rows per second")
    add(
        "--taxel-order",
        choices=ORDERS,
        help="order of the 48 numbers: taxel (x y z of each in turn) or axis (x of all, then y, "
        "then z); default: by the resting counts",
    )
    forces, torques = ", ".join(FORCE_UNITS), ", ".join(TORQUE_UNITS)
    add("--units", metavar="UNIT", help=f"of forces that do not say theirs: {forces}")
    add("--torque-units", metavar="UNIT", help=f"of torques that do not say theirs: {torques}")
    add("--ignore", action="append", default=[], metavar="NAME", help="leave out this CSV column")
    parser.epilog = (
        "Each of the files may be given several times, as NAME=PATH with the name of its stream: "
        "--video top=a.avi --video side=b.avi. A rate without a name applies to all of its kind."
    )
    add("--trim", action="store_true", help="cut all to the shortest of the recordings")


def run(options: argparse.Namespace) -> int:
    """Write the session and print what was assumed."""
    request = ImportRequest(
        out=options.session,
        sensor=options.sensor,
        indenter=options.indenter,
        video=_named("--video", options.video, "camera", Path),
        force=_named("--force", options.force, "force", Path),
        taxels=_named("--taxels", options.taxels, "taxels", Path),
        fps=_rates("--fps", options.fps),
        force_hz=_rates("--force-hz", options.force_hz),
        taxels_hz=_rates("--taxels-hz", options.taxels_hz),
        taxel_order=options.taxel_order,
        units=options.units,
        torque_units=options.torque_units,
        ignore=tuple(options.ignore),
        trim=options.trim,
        operator=options.operator,
    )
    with ItemProgress("rows", sys.stderr) as progress:
        lines = import_session(request, progress)
    for line in lines:
        print(line)
    print(f"{options.session}: imported")
    return 0


def _named(
    option: str, texts: list[str], default: str, convert: Callable[[str], Value]
) -> dict[str, Value]:
    """Return the values of a repeated option [NAME=]VALUE by name.

    Raises:
        SessionError: A name is given twice.
    """
    found: dict[str, Value] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not _NAME.fullmatch(name):
            name, value = default, text
        if name in found:
            raise SessionError(
                f"{option}: found {name or value!r} twice; name them: {option} NAME=..."
            )
        found[name] = convert(value)
    return found


def _rates(option: str, texts: list[str]) -> float | dict[str, float] | None:
    """Return one rate for all, rates by stream, or None if none is given.

    Raises:
        SessionError: Not a number.
    """
    try:
        found = _named(option, texts, "", float)
    except ValueError:
        raise SessionError(f"{option}: found {texts}; allowed: numbers, or NAME=number") from None
    return found[""] if found.keys() == {""} else found or None
