"""Command line of learning: `python -m learning VERB`; imports only the module of that command."""

from __future__ import annotations

import argparse
import sys
from importlib import import_module

from learning.command import EXIT_WRONG_INPUT, run

# The module of each command, below `learning`, and its line in the list of commands.
_COMMANDS = {
    # Data
    "markers": ("cli.markers", "make a marker archive of recorded sessions"),
    "import-genforce": (
        "cli.import_genforce",
        "make a marker archive of the published GenForce folders",
    ),
    "export-genforce": (
        "cli.export_genforce",
        "write a marker archive as a GenForce training folder",
    ),
    "split": ("cli.split", "assign each press of an archive to training or to a held-out part"),
    # Sensor to sensor
    "train-field": (
        "translation.field.command",
        "train the field translator on a group of sensors",
    ),
    "train-autoencoder": (
        "translation.direct.autoencoder_command",
        "train the marker autoencoder, from which the direct translator starts",
    ),
    "train-direct": (
        "translation.direct.command",
        "train the direct translator on a group of sensors",
    ),
    "train-marker-vae": (
        "translation.diffusion.vae_command",
        "train the autoencoder that the paper's translator needs",
    ),
    "train-diffusion": (
        "translation.diffusion.command",
        "train the paper's translator from SD-Turbo's weights",
    ),
    "import-weights": (
        "translation.diffusion.weights_command",
        "convert the authors' published checkpoints",
    ),
    "translate": ("cli.translate", "translate frames of one sensor into frames of another"),
    # Forces
    "compensate": (
        "compensation.command",
        "fit material priors and choose how labels are scaled between skins",
    ),
    "train-force": ("force.command", "train a force model on labelled presses"),
    "export-onnx": ("cli.export_onnx", "write one step of a force model as ONNX"),
    # Results
    "predict": ("cli.predict", "predict the forces of frames"),
    "evaluate": ("cli.evaluate", "write the report of predictions and translations"),
    "experiment": (
        "cli.experiment",
        "translate, train, compensate and evaluate all pairs of an archive",
    ),
}


def arguments(verb: str = "") -> argparse.ArgumentParser:
    """Return a parser that lists all commands and has the options of one.

    Args:
        verb: The command whose options are added; empty for the list of commands alone.
    """
    parser = argparse.ArgumentParser(
        prog="python -m learning",
        description="Force sensing on sensors without force labels, from recordings: marker "
        "archives, translators between sensors, force models, reports.",
    )
    subcommands = parser.add_subparsers(dest="verb", required=True)
    for name, (module, line) in _COMMANDS.items():
        if name == verb:
            import_module(f"learning.{module}").add_to(subcommands)
        else:
            subcommands.add_parser(name, help=line)
    return parser


# Commands that are benchmarks now, and their names there.
_MOVED = {"bench": "latency", "tables": "learning-tables"}


def main(argv: list[str] | None = None) -> int:
    """Run one command and return the exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words and words[0] in _MOVED:
        now = f"python -m benchmarks {_MOVED[words[0]]}"
        print(
            f"wrong input: {words[0]!r} has moved; run, from the repository: {now}", file=sys.stderr
        )
        return EXIT_WRONG_INPUT
    return run(arguments(words[0] if words else ""), words)


if __name__ == "__main__":
    sys.exit(main())
