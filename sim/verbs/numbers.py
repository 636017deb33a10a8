"""What a person types, read: numbers, lists of numbers, pairs."""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence

MM = 1e-3


def metres(millimetres: float) -> float:
    """A length in [m]; divided, so that 9 mm are 0.009 m to the last digit."""
    return millimetres / 1e3


def numbers(count: int | None = None) -> Callable[[str], tuple[float, ...]]:
    """The reader of numbers between commas: `count` of them, or one and more."""
    allowed = f"{count} numbers" if count else "numbers"
    example = ",".join(["1.5", "2", "0"][: count or 3])

    def read(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if not values or (count is not None and len(values) != count):
            raise argparse.ArgumentTypeError(
                f"{text!r}; allowed: {allowed} between commas, such as {example}"
            )
        return values

    return read


def branches(text: str) -> tuple[tuple[float, float], ...] | None:
    """Pairs `ratio:time` between commas; `none` is None."""
    if text == "none":
        return None
    try:
        pairs = [part.split(":") for part in text.split(",")]
        return tuple((float(ratio), float(time)) for ratio, time in pairs)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r}; allowed: ratio:seconds between commas, such as 0.3:0.1,0.5:2, or none"
        ) from None


def joined(argv: Sequence[str]) -> list[str]:
    """`argv` with values such as `-4,0` tied to the option before them.

    argparse would take them for options: it knows negative numbers, but no lists of them.
    """
    tied: list[str] = []
    for word in argv:
        after_option = bool(tied) and tied[-1].startswith("--") and "=" not in tied[-1]
        if after_option and re.match(r"-[.\d][^=]*,", word):
            tied[-1] += f"={word}"
        else:
            tied.append(word)
    return tied
