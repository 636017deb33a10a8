"""Presses of source and target in one archive, without the target's labels; labels by place."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.data.join import join
from learning.data.labels import read_labels
from learning.data.matching import SensorSelection, Tolerances
from recorder import MarkerArchive
from recorder.archive import press_rows
from recorder.progress import ItemProgress
from recorder.spec import PHASES

Floats = NDArray[np.float64]

_NORMAL = (PHASES.index("normal_inc"), PHASES.index("normal_dec"))
# Largest difference of progress by which a frame is beyond those of the other sensor.
_BEYOND = 0.02


def join_pair(
    source: SensorSelection,
    target: SensorSelection,
    out: Path,
    tolerances: Tolerances,
    unseen: tuple[str, ...] | None,
    *,
    source_labels: Path | None = None,
    keep_curve: bool,
) -> tuple[MarkerArchive, list[str]]:
    """Write the presses of both sensors to one archive; return it, and the table of matches.

    The target's labels are not copied, so that no later stage can read them; with `keep_curve` the
    forces of its force-depth presses are. Its rows stay in order: row k is row k of its own
    archive. Labels of a CSV replace those of the source's archive; `unseen` replaces its indenters
    that models may not be trained on.
    """
    wrenches = {target.name: _without_labels(target, keep_curve=keep_curve)}
    if source_labels is not None:
        labels = read_labels(source_labels, source.archive, source.sensor)
        forces = labels.of_all(len(source.archived))
        wrenches[source.name] = np.pad(forces, ((0, 0), (0, 3)), constant_values=np.nan)
    joined = join([source, target], tolerances, unseen, wrenches=wrenches)
    with ItemProgress("frames of both sensors", sys.stderr) as progress:
        joined.write(out, progress)
    return MarkerArchive(out), list(joined.lines())


def _without_labels(target: SensorSelection, *, keep_curve: bool) -> Floats:
    """Return the wrenches of a sensor (n, 6), NaN but for force-depth presses if they are kept."""
    table = target.archived.table
    wrench = np.full(table["wrench"].shape, np.nan)
    if keep_curve:
        curve = table["location"] < 0
        wrench[curve] = table["wrench"][curve]
    return wrench


def labels_by_place(
    source: Mapping[str, NDArray[Any]], labels: Floats, target: Mapping[str, NDArray[Any]]
) -> Floats:
    """Return the source's labels at the frames of the target (n, 3) [N]; NaN without one.

    Frames of one location and phase match by progress: depth over the deepest while pressing,
    distance over the longest while shearing; labels between two frames are interpolated. A phase
    of the source begins with the last frame of the one before.

    Labels are of all rows of the source's table (m, 3) [N].
    """
    matched = np.full((len(target["location"]), 3), np.nan)
    mine, its = _phases(source, begun=True), _phases(target, begun=False)
    for key in its.keys() & mine.keys():
        rows, at = its[key]
        own, own_at = mine[key]
        order = np.argsort(own_at, kind="stable")
        own, own_at = own[order], own_at[order]
        inside = (at >= own_at[0] - _BEYOND) & (at <= own_at[-1] + _BEYOND)
        for axis in range(3):
            values = labels[own, axis]
            labelled = np.isfinite(values)
            if labelled.any():
                column = np.interp(at, own_at[labelled], values[labelled])
                matched[rows, axis] = np.where(inside, column, np.nan)
    return matched


def _phases(
    table: Mapping[str, NDArray[Any]], *, begun: bool
) -> dict[tuple[int, int], tuple[NDArray[np.int64], Floats]]:
    """Return rows and progress, 0 to 1, of each phase, if `begun` from the last frame before it."""
    phases: dict[tuple[int, int], tuple[NDArray[np.int64], Floats]] = {}
    for (location,), location_rows in press_rows(table).items():
        phase = table["phase"][location_rows]
        depth = np.asarray(table["depth"][location_rows], np.float64)
        position = np.asarray(table["position"][location_rows], np.float64)
        pressed = location_rows[np.isin(phase, _NORMAL)]
        start = table["position"][pressed[0] if len(pressed) else location_rows[0]]
        away = np.linalg.norm(position - np.asarray(start, np.float64), axis=1)
        for code in np.unique(phase).tolist():
            chosen = phase == code
            if begun:
                chosen[np.maximum(np.flatnonzero(chosen)[0] - 1, 0)] = True
            measure = depth if code in _NORMAL or code < 0 else away
            most = measure.max()
            progress = measure[chosen] / most if most > 0 else np.zeros(chosen.sum())
            phases[location, code] = location_rows[chosen], progress
    return phases
