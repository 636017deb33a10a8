"""`tactile models`: take trained models from a folder or web address, or publish one."""

from __future__ import annotations

import argparse
from pathlib import Path

from recorder import models


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Models are folders with weights (safetensors, ONNX) and a card: data, splits, seeds, "
        "errors with intervals, licence. Sizes and hashes of all files are checked."
    )
    kinds = parser.add_subparsers(dest="kind", required=True)
    for name, text in (
        ("list", "list the models of a place, and the user's own"),
        ("get", "copy a model to models/NAME"),
        ("use", "make a model the default of `tactile live`"),
        ("add", "publish a model in a folder"),
    ):
        own = kinds.add_parser(name, help=text, description=text)
        if name in ("get", "use"):
            own.add_argument("name", metavar="NAME", help="name of the model")
        if name == "add":
            own.add_argument("model", type=Path, metavar="MODEL", help="folder of a force model")
            own.add_argument("--name", required=True, metavar="NAME", help="name to publish it by")
            own.add_argument("--to", type=Path, required=True, metavar="DIR", help="folder")
            own.add_argument("--card", type=Path, required=True, metavar="FILE", help="its card")
            own.add_argument("--licence", default="Apache-2.0", help="SPDX name (%(default)s)")
            continue
        if name in ("list", "get"):
            own.add_argument(
                "--from",
                dest="place",
                metavar="PLACE",
                help="folder or web address (models of this package)",
            )
        own.add_argument(
            "--out", type=Path, default=models.OWN, metavar="DIR", help="own models (%(default)s)"
        )


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    actions = {"list": _list, "get": _get, "use": _use, "add": _add}
    actions[options.kind](options)
    return 0


def _list(options: argparse.Namespace) -> None:
    for model in models.listed(options.place or models.packaged()):
        size = sum(file.bytes for file in model.files) / 1e6
        taken = " (taken)" if (options.out / model.name).is_dir() else ""
        print(f"{model.name}{taken}: {size:.1f} MB, {model.licence}; {model.text}")


def _get(options: argparse.Namespace) -> None:
    folder = models.get(options.name, options.place or models.packaged(), options.out)
    print(f"{folder}: hashes agree; tactile live --model {options.name}")


def _use(options: argparse.Namespace) -> None:
    print(f"{models.use(options.name, options.out)}: is the model of `tactile live` here")


def _add(options: argparse.Namespace) -> None:
    from learning.errors import LearningError
    from learning.force.publish import publish

    if not options.card.is_file():
        raise LearningError(f"--card: found no {options.card}; allowed: a file of text")
    card = options.card.read_text(encoding="utf-8")
    found = publish(options.model, options.to, options.name, card, licence=options.licence)
    print(f"{options.to / options.name}: {len(found.files)} files; listed in {models.INDEX}")
