"""Command line of learning: `python -m learning VERB`; only the verb's own module is imported."""

from __future__ import annotations

import argparse
import sys
from importlib import import_module

from learning.command import EXIT_WRONG_INPUT, run

# The module of each verb, below `learning`, and its line in the list of verbs.
_VERBS = {
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
    "split": ("cli.split", "say which presses models are trained on and which they are tested on"),
    # From sensor to sensor
    "train-field": (
        "translation.field.command",
        "train the field translator on a group of sensors",
    ),
    "train-autoencoder": (
        "translation.direct.autoencoder_command",
        "train the marker autoencoder on any archives",
    ),
    "train-direct": (
        "translation.direct.command",
        "train the direct translator on a group of sensors",
    ),
    "train-marker-vae": (
        "translation.diffusion.vae_command",
        "train the autoencoder of the paper's translator, before that",
    ),
    "train-diffusion": (
        "translation.diffusion.command",
        "train the paper's translator on SD-Turbo",
    ),
    "import-weights": (
        "translation.diffusion.weights_command",
        "make the authors' published checkpoints usable",
    ),
    "translate": ("cli.translate", "make of a sensor's frames what another would have shown"),
    # Forces
    "compensate": (
        "compensation.command",
        "fit material priors, choose how labels are brought from skin to skin",
    ),
    "train-force": ("force.command", "train a force model on labelled presses"),
    "export-onnx": ("cli.export_onnx", "write one step of a force model as ONNX"),
    # What came of it
    "predict": ("cli.predict", "predict the forces of frames"),
    "evaluate": ("cli.evaluate", "write the report of predictions and translations"),
    "experiment": (
        "cli.experiment",
        "translate, train, compensate, evaluate: all pairs of an archive, one report",
    ),
}


def arguments(verb: str = "") -> argparse.ArgumentParser:
    """Return a parser that knows all verbs, and the options of one.

    Args:
        verb: Whose options; none where the list of verbs is all that is asked for.
    """
    parser = argparse.ArgumentParser(
        prog="python -m learning",
        description="From recordings to forces on sensors that never saw a force gauge: marker "
        "archives, translators from sensor to sensor, force models, reports.",
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    for name, (module, line) in _VERBS.items():
        if name == verb:
            import_module(f"learning.{module}").add_to(verbs)
        else:
            verbs.add_parser(name, help=line)
    return parser


# Verbs that measured, and the benchmark that each is now.
_MOVED = {"bench": "latency", "tables": "learning-tables"}


def main(argv: list[str] | None = None) -> int:
    """Run one verb; the exit code."""
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
