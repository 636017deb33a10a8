"""Labels of another sensor, carried to a sensor's own frames where presses match by place."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from learning.compensation.fit import (
    CHOICE_OF_METHOD,
    Curves,
    gather_priors,
    read_stored,
    write_compensation,
)
from learning.compensation.search import depth_range
from learning.compensation.simulated import SIMULATED
from learning.data.matching import SensorSelection, Tolerances
from learning.errors import LearningError
from learning.experiment.stages import relabelling
from learning.force.intervals import Scale
from learning.transfer.pairs import join_pair, labels_by_place
from learning.translation.archive import Pair
from recorder import MarkerArchive

Floats = NDArray[np.float64]
Say = Callable[[str], None]

# Factors of the scale that are assumed: without any force on the target; with force-depth curves or
# twins of both skins.
NOTHING, CURVES = 2.0, 1.25
# Methods, as of experiments: the source's labels as they are, and scaled by curves.
UNSCALED, BY_CURVES = "transferred", "priors"
# Relative difference of two depth ranges below which forces at the same fraction compare.
_AS_DEEP = 0.1


@dataclass(frozen=True, slots=True)
class CarryRequest:
    """A sensor with labels, one without, and references for the forces of both."""

    source: SensorSelection
    target: SensorSelection
    out: Path
    """Folder of the joined archive and of the curves."""
    priors: tuple[Path, ...] = ()
    """Force references of the target: sessions of `force-depth`, a folder of published
    coefficients, or the target's own archive."""
    source_labels: Path | None = None
    """CSV of labels of the source, in place of those of its archive."""
    ratio: float | None = None
    """Assumed force of the target over the source's at the same fraction of depth; None: 1."""
    within: float | None = None
    """Factor within which the scale is assumed to be; None: by what is known."""
    unseen: tuple[str, ...] | None = None
    """Indenters that no stage uses; None: as in the archives."""
    tolerances: Tolerances = field(default_factory=Tolerances)
    """Largest differences of presses that match."""

    @property
    def assumed(self) -> float:
        """Factor on labels that nothing scales between the skins."""
        return 1.0 if self.ratio is None else self.ratio


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """Labels of a target's frames."""

    archive: MarkerArchive
    """Presses of both sensors, without the target's labels."""
    forces: Floats
    """Fx, Fy, Fz of all rows of the target (n, 3) [N]; NaN where no press matches."""
    scale: Scale
    """Knowledge of the factor between them and the true ones."""
    method: str
    """Scaling between the skins, a method of evaluations."""


def carry(request: CarryRequest, say: Say = print) -> Carried:
    """Match the presses of both sensors, and return the source's labels at the target's frames.

    The target's labels are not copied, so no later stage can read them. Labels are scaled between
    the skins by twins if both archives have their forces, else by force-depth curves if both have
    one, else not.

    Raises:
        LearningError: No press matches, a prior names no curve, or an assumed scale would compare
            sensors that are not pressed as deep.
    """
    request.out.mkdir(parents=True, exist_ok=True)
    archive, matches = join_pair(
        request.source,
        request.target,
        request.out / "pairs.markers.zarr",
        request.tolerances,
        request.unseen,
        source_labels=request.source_labels,
        keep_curve=any(_is_same(path, request.target.archive) for path in request.priors),
    )
    for line in matches:
        say(line)
    source, target = request.source.name, request.target.name
    method, curves = UNSCALED, request.out / "compensation.json"
    if all(archive[name].simulated is not None for name in (source, target)):
        method = SIMULATED
    elif _compensated(request, archive, curves, say):
        method = BY_CURVES
    if method == UNSCALED:
        _require_as_deep(request, archive)
    stored = read_stored(curves) if method in CHOICE_OF_METHOD else None
    relabelled = relabelling(archive, Pair(source, target), method, stored)
    table = archive[source].table
    labels = np.full((len(table["location"]), 3), np.nan)
    rows = np.flatnonzero(table["valid"] & (table["location"] >= 0) & table["seen"])
    if relabelled is None:
        labels[rows] = table["wrench"][rows, :3]
    else:
        labels[rows] = relabelled.at(table, rows)
    forces = labels_by_place(table, labels, archive[target].table)
    if method == UNSCALED:
        forces *= request.assumed
    return Carried(archive, forces, _scale(request, method), method)


def _is_same(path: Path, archive: MarkerArchive) -> bool:
    return path.exists() and path.resolve() == Path(archive.path).resolve()


def _compensated(request: CarryRequest, archive: MarkerArchive, out: Path, say: Say) -> bool:
    """Fit the skins' force-depth curves; return False if one of both has none."""
    folders = [p for p in request.priors if not _is_same(p, request.target.archive)]
    sessions = [p for p in folders if not any(p.glob("*_down.csv"))]
    published = [p for p in folders if p not in sessions]
    if len(published) > 1:
        raise LearningError(f"--priors: found {len(published)} folders of CSV; allowed: one")
    curves = Curves(tuple(sessions), published[0] if published else None)
    source, target = request.source.name, request.target.name
    without = sorted({source, target} & set(gather_priors(archive, curves).without))
    if without:
        if request.priors:
            raise LearningError(
                f"--priors: no force-depth curve of {', '.join(without)} in any of them; allowed: "
                "a session of `tactile force-depth`, a folder of SENSOR_down.csv and "
                "SENSOR_up.csv, the target's own archive if it has force-depth presses"
            )
        say(f"no force-depth curve of {', '.join(without)}: labels are not scaled between skins")
        return False
    say("\n".join(write_compensation(archive, out, pairs=[(source, target)], curves=curves)))
    choices = read_stored(out).pairs[0].choices
    if CHOICE_OF_METHOD[BY_CURVES] not in choices:
        raise LearningError(
            f"--priors: the curves of {source} and {target} give no common scale (see "
            f"{out.with_suffix('.png')}); allowed: other curves, or --force-ratio without any"
        )
    return True


def _scale(request: CarryRequest, method: str) -> Scale:
    """Return what is known of the scale before any weight or label."""
    if method != UNSCALED:
        text = "force-depth curves of both skins; their ratio is assumed to hold for all indenters"
        if method == SIMULATED:
            text = "twins of both skins, which simulate every press; their ratio is assumed to hold"
        return Scale(request.within or CURVES, text, assumed=False)
    text = (
        f"assumed that {request.target.name} takes {request.assumed:g} times the force of "
        f"{request.source.name} at the same place and fraction of depth; no force on it was ever "
        "known"
    )
    return Scale(request.within or NOTHING, text, assumed=True)


def _require_as_deep(request: CarryRequest, archive: MarkerArchive) -> None:
    """Reject an assumed scale between sensors that are not pressed as deep."""
    if request.ratio is not None:
        return
    names = request.source.name, request.target.name
    deepest = [depth_range(archive[name]) or 0.0 for name in names]
    if abs(deepest[0] - deepest[1]) > _AS_DEEP * max(deepest):
        raise LearningError(
            f"{request.source.name} was pressed {1e3 * deepest[0]:.2f} mm deep, "
            f"{request.target.name} {1e3 * deepest[1]:.2f} mm: at the same fraction of depth their "
            "forces differ by more than the skins' moduli; allowed: --priors with force-depth "
            "curves, --force-ratio, or a (simulated) source pressed as deep"
        )
