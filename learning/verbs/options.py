"""What verbs share: the type of their parsers, and lists of names."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from learning.errors import LearningError
from learning.indenters import UNSEEN

if TYPE_CHECKING:
    Verbs = argparse._SubParsersAction[argparse.ArgumentParser]


def add_unseen(parser: argparse.ArgumentParser) -> None:
    """Add the option that says which indenters are held out."""
    parser.add_argument(
        "--unseen",
        metavar="NAME,...",
        help=f"indenters that models may not be trained on ({','.join(UNSEEN)}; none: '')",
    )


def unseen(listed: str | None) -> tuple[str, ...]:
    """Return the indenters that are held out."""
    return UNSEEN if listed is None else tuple(name for name in listed.split(",") if name)


def by_name(given: list[str] | None, option: str) -> dict[str, float]:
    """Return numbers given as NAME=NUMBER.

    Raises:
        LearningError: Not of that form.
    """
    found = {}
    for text in given or []:
        name, _, number = text.partition("=")
        try:
            found[name] = float(number)
        except ValueError:
            raise LearningError(f"{option}: found {text!r}; allowed: NAME=NUMBER") from None
    return found
