"""The layout of simulated data: pictures of a pattern by place and depth.

<Pattern>_ref.jpg
<indenter>/<Pattern>/<x>_<y>_<depth>.jpg      x, y, depth in mm
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from learning.data.genforce.format import SUFFIXES, GenForcePress, Packed, no_phases, read_mask
from learning.errors import LearningError

_NUMBER = r"-?\d+(?:\.\d+)?"
_STATE = re.compile(rf"({_NUMBER})_({_NUMBER})_({_NUMBER})")

PressState = tuple[float, float, float]


def is_states(root: Path) -> bool:
    """Return True if a folder has this layout."""
    return any(root.glob("*_ref.*")) and not (root / "img").exists()


def indenters_of(root: Path) -> set[str]:
    """Return the names of the indenters in a folder."""
    return {path.name for path in root.iterdir() if path.is_dir() and path.name[0] != "."}


def read_states(
    root: Path, codes: Mapping[str, int]
) -> Iterator[tuple[str, Packed, tuple[GenForcePress, ...]]]:
    """Yield patterns: name, packed reference (38400,), and a press for each place.

    Places are numbered by x, then y, depths in ascending order, over all files; a location is a
    place and a depth. Simulated archives are numbered in the same way.
    """
    names = sorted(path.stem.removesuffix("_ref") for path in root.glob("*_ref.*"))
    shapes = sorted(indenters_of(root))
    found = {(shape, name): _states(root / shape / name) for shape in shapes for name in names}
    every = {state for states in found.values() for state in states}
    if not every:
        raise LearningError(f"{root}: found no <indenter>/<Pattern>/<x>_<y>_<depth>.jpg")
    places = sorted({state[:2] for state in every})
    depths = sorted({state[2] for state in every})
    for name in names:
        presses = []
        for shape in shapes:
            states = found[shape, name]
            for target, (x, y) in enumerate(places):
                here = [(depth, states[x, y, depth]) for depth in depths if (x, y, depth) in states]
                if here:
                    first = (codes[shape] * len(places) + target) * len(depths)
                    presses.append(_press(shape, target, (x, y), here, depths, first))
        yield name, _reference(root, name), tuple(presses)


def _press(
    shape: str,
    target: int,
    place: tuple[float, float],
    here: list[tuple[float, Path]],
    depths: list[float],
    first_location: int,
) -> GenForcePress:
    count = len(here)
    return GenForcePress(
        indenter=shape,
        target=target,
        files=tuple(path for _, path in here),
        phase=no_phases(count),
        wrench=np.full((count, 6), np.nan),
        depth=np.array([depth for depth, _ in here]) * 1e-3,
        position=np.tile(np.array(place) * 1e-3, (count, 1)),
        location=np.array([first_location + depths.index(depth) for depth, _ in here]),
    )


def _states(folder: Path) -> dict[PressState, Path]:
    if not folder.is_dir():
        return {}
    states: dict[PressState, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix not in SUFFIXES:
            continue
        named = _STATE.fullmatch(path.stem)
        if named is None:
            raise LearningError(f"{path}: expected a name <x>_<y>_<depth>{path.suffix}, in mm")
        x, y, depth = (float(number) for number in named.groups())
        if depth < 0 or (x, y, depth) in states:
            raise LearningError(f"{path}: found a depth below 0, or a duplicate state")
        states[x, y, depth] = path
    return states


def _reference(root: Path, name: str) -> Packed:
    for suffix in SUFFIXES:
        if (root / f"{name}_ref{suffix}").exists():
            return read_mask(root / f"{name}_ref{suffix}")
    raise LearningError(f"{root / name}_ref.jpg: no such file, nor .npy; expected the reference")
