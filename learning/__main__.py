"""Command line of learning: `python -m learning VERB`; every verb is a file of `learning.verbs`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from learning.errors import LearningError
from learning.verbs import (
    compensate,
    evaluate,
    experiment,
    export_genforce,
    export_onnx,
    import_genforce,
    import_weights,
    markers,
    predict,
    split,
    train_autoencoder,
    train_diffusion,
    train_direct,
    train_field,
    train_force,
    train_marker_vae,
    translate,
)
from recorder import SessionError

EXIT_WRONG_INPUT = 2
EXIT_INTERRUPTED = 130

_VERBS = (
    # Data
    markers,
    import_genforce,
    export_genforce,
    split,
    # From sensor to sensor
    train_field,
    train_autoencoder,
    train_direct,
    train_marker_vae,
    train_diffusion,
    import_weights,
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


def run(parser: argparse.ArgumentParser, argv: Sequence[str]) -> int:
    """Run the verb that `argv` names; errors are printed, the exit code says which they are."""
    options = parser.parse_args(argv)
    try:
        return int(options.run(options))
    except (LearningError, SessionError) as error:
        print(f"wrong input: {error}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except OSError as error:
        print(f"cannot read or write: {error}", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except KeyboardInterrupt:
        print("interrupted; the same command goes on with an archive", file=sys.stderr)
        return EXIT_INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
