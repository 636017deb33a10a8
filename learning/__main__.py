"""Command line of learning: `python -m learning VERB`; every verb is a file of `learning.verbs`."""

from __future__ import annotations

import argparse
import sys

from learning.errors import LearningError
from learning.verbs import export_genforce, import_genforce, markers
from recorder import SessionError

EXIT_WRONG_INPUT = 2
EXIT_INTERRUPTED = 130

_VERBS = (markers, import_genforce, export_genforce)


def arguments() -> argparse.ArgumentParser:
    """The parser of every verb and its options."""
    parser = argparse.ArgumentParser(
        prog="python -m learning",
        description="Marker archives from sessions and from published recordings.",
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in _VERBS:
        verb.add_to(verbs)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run one verb; the exit code."""
    options = arguments().parse_args(argv)
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
