"""Names of indenters, in one order for all archives so that codes and locations agree."""

from collections.abc import Iterable

# The paper's indenters; simulated archives have the same ones in the same order.
NAMES = (
    "sphere",
    "sphere_s",
    "hemisphere",
    "cone",
    "cylinder",
    "cylinder_sh",
    "cylinder_si",
    "torus",
    "dotin",
    "dots",
    "wave",
    "prism",
    "line",
    "hexagon",
    "triangle",
    "pacman",
    "moon",
    "random",
)
# Indenters that the paper's models are tested on and never trained on.
UNSEEN = ("sphere_s", "triangle", "pacman", "cone", "wave", "torus")


def coded(names: Iterable[str]) -> tuple[str, ...]:
    """Return the indenters of an archive by code: `NAMES`, then others in alphabetical order."""
    return (*NAMES, *sorted(set(names) - set(NAMES)))
