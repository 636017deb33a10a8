"""Command line of learning: `python -m learning VERB`; every verb is a file of `learning.cli`."""

from __future__ import annotations

import argparse
import sys

from learning.cli import (
    evaluate,
    experiment,
    export_genforce,
    export_onnx,
    import_genforce,
    markers,
    predict,
    split,
    translate,
)
from learning.command import EXIT_WRONG_INPUT, run
from learning.compensation import command as compensate
from learning.force import command as train_force
from learning.translation.diffusion import command as train_diffusion
from learning.translation.diffusion import vae_command, weights_command
from learning.translation.direct import autoencoder_command
from learning.translation.direct import command as train_direct
from learning.translation.field import command as train_field

_VERBS = (
    # Data
    markers,
    import_genforce,
    export_genforce,
    split,
    # From sensor to sensor
    train_field,
    autoencoder_command,
    train_direct,
    vae_command,
    train_diffusion,
    weights_command,
    translate,
    # Forces
    compensate,
    train_force,
    export_onnx,
    # What came of it
    predict,
    evaluate,
    experiment,
)


def arguments() -> argparse.ArgumentParser:
    """The parser of every verb and its options."""
    parser = argparse.ArgumentParser(
        prog="python -m learning",
        description="From recordings to forces on sensors that never saw a force gauge: marker "
        "archives, translators from sensor to sensor, force models, reports.",
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in _VERBS:
        verb.add_to(verbs)
    return parser


_MOVED = {"bench": "latency", "tables": "learning-tables"}
"""Verbs that measured, and the benchmark that each is now."""


def main(argv: list[str] | None = None) -> int:
    """Run one verb; the exit code."""
    words = sys.argv[1:] if argv is None else argv
    if words and words[0] in _MOVED:
        now = f"python -m benchmarks {_MOVED[words[0]]}"
        print(
            f"wrong input: {words[0]!r} has moved; run, from the repository: {now}", file=sys.stderr
        )
        return EXIT_WRONG_INPUT
    return run(arguments(), words)


if __name__ == "__main__":
    sys.exit(main())
