"""What error a person accepts: "2 %", "0.05 N" or "0.5 px"."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

from sim.errors import SceneError

Kind = Literal["share", "force", "marker"]
KINDS: tuple[Kind, ...] = ("share", "force", "marker")
ALLOWED = 'a number above 0 with its unit: "2 %", "0.05 N" or "0.5 px"'
_UNITS: dict[str, tuple[Kind, float]] = {
    "%": ("share", 0.01),
    "N": ("force", 1.0),
    "mN": ("force", 1e-3),
    "px": ("marker", 1.0),
}


@dataclass(frozen=True, slots=True)
class Tolerance:
    """The largest error accepted at any frame.

    `share`: |F_i - Ftrue_i| along x, y or z over max(|Ftrue| of the frame, a tenth of the largest);
    `force`: |F_i - Ftrue_i| [N]; `marker`: root mean square of the distances between 14 x 14
    markers' images and where they should be [px], seen by the paper's camera.
    """

    kind: Kind
    value: float

    def __str__(self) -> str:
        """As a person writes it."""
        return said(self.kind, self.value)


def tolerance_of(text: str) -> Tolerance:
    """The tolerance that `text` writes.

    Raises:
        SceneError: It is none.
    """
    match = re.fullmatch(r"\s*(\S+?)\s*(%|mN|N|px)\s*", text) if isinstance(text, str) else None
    try:
        number = float(match[1]) if match else math.nan
    except ValueError:
        number = math.nan
    if match is None or not (math.isfinite(number) and number > 0):
        raise SceneError(f"tolerance: {text!r}; allowed: {ALLOWED}")
    kind, unit = _UNITS[match[2]]
    return Tolerance(kind, number * unit)


def said(kind: Kind, value: float) -> str:
    """A value of a kind with its unit."""
    if kind == "share":
        return f"{100 * value:.3g} %"
    return f"{value:.3g} {'N' if kind == 'force' else 'px'}"
