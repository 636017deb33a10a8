"""Natural sort order of names: numbers in them count as numbers."""

import re
from collections.abc import Callable, Iterable
from typing import TypeVar

T = TypeVar("T")
# A number with a decimal point, beside which there is no further number as in 1.9.10.
_DECIMAL = r"(?<!\d)(?<!\d\.)\d*\.\d+(?!\.?\d)"


def natural_key(name: str, number: str = r"\d+") -> list[tuple[int, int, str]]:
    """Return the key that sorts image_2 before image_10; `number` is the pattern of a number."""
    keys = []
    for k, part in enumerate(re.split(f"({number})", name)):
        whole, _, after = part.partition(".")
        keys.append((0, int(whole or 0), after) if k % 2 else (1, 0, part))
    return keys


def naturally_sorted(items: Iterable[T], name: Callable[[T], str]) -> list[T]:
    """Return items in natural order of their names.

    Numbers after a point are decimals, as in 0.05 0.1 0.15, unless they count, as in 1.1 1.9 1.10
    or .01 .99 .101: decimals of unequal length do not end in a zero, or begin with one.
    """
    items = list(items)
    found = [n.partition(".") for item in items for n in re.findall(_DECIMAL, name(item))]
    shortest = min((len(after) for *_, after in found), default=0)
    longer = [after for *_, after in found if len(after) > shortest]
    counted = any(after[-1] == "0" for after in longer) or not all(whole for whole, *_ in found)
    decimals = any(after[0] == "0" for after in longer) or not counted
    number = rf"{_DECIMAL}|\d+" if decimals else r"\d+"
    return sorted(items, key=lambda item: natural_key(name(item), number))
