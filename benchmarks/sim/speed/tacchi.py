"""Tacchi's and GenForce's own program on the same work: cited, not measured here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Cited:
    """A way to run their method, and its time for 18 indenters x 9 places x 5 depths."""

    name: str
    press: str
    """Time of one press to all five depths on 2 CPU cores, kernels compiled."""
    cpu: str
    """Time of all presses on 2 CPU cores."""
    gpu: str
    """Time of all presses on one H200; empty if not run."""


CITED = (
    Cited(
        "GenForce as released: 25 x 25 x 5 mm, a process for each depth, 40 mm/s",
        "5 x 218 s",
        "38 h",
        "",
    ),
    Cited(
        "the paper's gel, one press to all depths, 40 mm/s, grid cropped to the gel",
        "176 s",
        "8.3 h",
        "750 s",
    ),
    Cited("the same at the paper's 10 mm/s", "4 times that", "32 h", "970 s"),
)
# Source of the numbers.
SOURCE = (
    "Taichi 1.7.4; on a CPU single presses were run and multiplied, on an H200 as well (4.6 s and "
    "6.0 s a press, 9 to 16 s more for each process to compile); good to 20 %"
)
