"""An archive filled with what it lacks, by whoever makes units, and closed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from recorder.archive import ArchiveWriter
from sim.archives.beginning import Begun
from sim.archives.families import Unit, families, units
from sim.archives.making import Made
from sim.archives.stopping import Stop

Inside = Callable[[float], None]
"""Told how much of the presses of the unit in hand is solved, where there is one at a time."""
Maker = Callable[[Sequence[Unit], Inside], Iterator[Made]]
"""Makes units and tells of each that is done."""


@dataclass(frozen=True, slots=True)
class Filled:
    """What one run did."""

    complete: bool
    """Whether the archive is; not when it was stopped."""
    images: int
    """Masks that this run wrote."""
    seconds: float
    """Time that it took."""
    solving: float
    """CPU time of presses [s]; on a GPU the time that they took."""
    seeing: float
    """The same of images, fields, packing and writing."""
    left: int
    """Units that are still missing."""


def fill(begun: Begun, maker: Maker, stop: Stop, progress: Callable[[float], None]) -> Filled:
    """Make what is missing and close the archive.

    Args:
        begun: The archive.
        maker: Makes the missing units.
        stop: Whether the maker left some on purpose.
        progress: Called with the share of all rows that are there.
    """
    began = time.perf_counter()
    missing = begun.missing()
    weights = {unit.number: _rows(begun, unit) for unit in units(begun.plan)}
    whole = sum(weights.values())
    done = whole - sum(weights[unit.number] for unit in missing)
    progress(done / whole)
    made: list[Made] = []

    def inside(share: float) -> None:
        """Presses are nearly all of a unit, and units are made in their order here."""
        now = missing[len(made)].number
        progress((done + share * weights[now]) / whole)

    for one in maker(missing, inside):
        made.append(one)
        done += weights[one.number]
        progress(done / whole)
    left = begun.missing() if stop.asked else ()
    if not left:
        ArchiveWriter(begun.path).finish()
    return Filled(
        complete=not left,
        images=sum(one.images for one in made),
        seconds=time.perf_counter() - began,
        solving=sum(one.solving for one in made),
        seeing=sum(one.seeing for one in made),
        left=len(left),
    )


def _rows(begun: Begun, unit: Unit) -> int:
    family = families(begun.plan)[unit.family]
    presses = family.presses[unit.first : unit.last]
    return sum(len(one) for press in presses for one in press.recordings)
