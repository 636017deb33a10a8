"""Natural sort order of names: numbers in them count as numbers."""

import re


def natural_key(name: str) -> list[tuple[int, int, str]]:
    """Return the key that sorts image_2 before image_10."""
    return [(0, int(p), "") if p.isdecimal() else (1, 0, p) for p in re.split(r"(\d+)", name)]
