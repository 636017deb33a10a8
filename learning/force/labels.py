"""Labels that a force model learns from: an archive's, typed readings, a twin's, compensated."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from learning.compensation.fit import CHOICE_OF_METHOD, PairCompensation, read_stored
from learning.compensation.simulated import SIMULATED, simulated_labels, twin_forces
from learning.data.labels import read_labels
from learning.data.presses import Presses
from learning.errors import LearningError
from learning.training.checkpoint import weights_hash
from recorder.archive import MarkerArchive, Simulated

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Relabelling:
    """Labels in place of a sensor's own."""

    forces: Callable[[Integers, Floats, Floats, Integers], Floats]
    """Forces (n, 3) [N] of rows (n,) of its table; these are given with the own forces (n, 3) [N],
    depths (n,) [m] and phases (n,) there."""
    spread: Floats | None = None
    """Standard deviation of the forces of all rows (m, 3) [N]; None: all are equally certain."""
    made_from: str = ""
    """Twins that they are from; empty: none."""

    def at(self, table: Mapping[str, NDArray[Any]], rows: Integers) -> Floats:
        """Return the forces (n, 3) [N] of rows (n,) of the sensor's table."""
        own, depth = (np.asarray(table[name][rows], np.float64) for name in ("wrench", "depth"))
        return self.forces(rows, own[:, :3], depth, table["phase"][rows].astype(np.int64))

    def of(self, presses: Presses) -> Presses:
        """Return presses with these labels."""
        rows = presses.rows.numpy()
        own = presses.wrench.double().cpu().numpy()
        forces = self.forces(rows, own, presses.depth.cpu().numpy(), presses.phase.cpu().numpy())
        device, spread = presses.wrench.device, presses.spread
        if self.spread is not None:
            spread = torch.from_numpy(self.spread[rows]).float().to(device)
        return replace(presses, wrench=torch.from_numpy(forces).float().to(device), spread=spread)


def by_twins(labels: Simulated) -> Relabelling:
    """Return labels that twins give to all rows of a sensor's table."""
    return Relabelling(lambda rows, *_: labels.force[rows], labels.spread, labels.made_from)


def compensated(pair: PairCompensation) -> Relabelling:
    """Return a source's own labels, scaled for a target."""
    return Relabelling(lambda _rows, own, depth, phase: pair.applied(own, depth, phase)[0])


# Labels of a training that are not the archive's, as its command names them.

TWIN = "twin"
_ARCHIVE = ".markers.zarr"


@dataclass(frozen=True, slots=True)
class LabelSource:
    """Labels of a training."""

    relabelling: Relabelling | None = None
    """None: the archive's own labels."""
    data: tuple[str, ...] = ()
    """Words that identify what they are made of."""
    method: str = "transferred"
    """Method of a model that learns them from translated frames, one of `METHODS`."""
    own_twin: bool = False
    """True if they are the forces of the sensor's own twin."""

    def of(self, presses: Presses) -> Presses:
        """Return presses with these labels."""
        return presses if self.relabelling is None else self.relabelling.of(presses)


def label_source(
    name: str | None, archive: MarkerArchive, sensors: Sequence[str], pair: str | None = None
) -> LabelSource:
    """Return the labels of a training by their name; None: the archive's labels.

    A name is a CSV of readings, `twin`, the archive of the target of a pair with forces of its
    twin, or FILE.json or FILE.json:CHOICE of `tactile compensate`. `pair` is A-to-B, labels of A
    for B, by default as the name of the only sensor says.
    """
    if name is None:
        if pair is not None:
            raise LearningError("--pair: found without --labels; allowed: both")
        return LabelSource()
    if len(sensors) > 1 and (pair is None or ".json" not in name):
        raise LearningError(
            f"--sensor: found {', '.join(sensors)}; allowed with --labels {name}: one, whose they "
            "are"
        )
    source, to, target = (pair or sensors[0]).partition("-to-")
    if name.endswith(".csv"):
        read = read_labels(Path(name), archive, sensors[0]).of_all(len(archive[sensors[0]]))
        return LabelSource(Relabelling(lambda rows, *_: read[rows]), (weights_hash(Path(name)),))
    if name == TWIN and not to:
        labels = twin_forces(archive[sensors[0]])
        return LabelSource(by_twins(labels), (labels.made_from,), own_twin=True)
    if not to:
        raise LearningError(
            f"--pair: found {pair or ','.join(sensors)}; allowed with --labels {name}: A-to-B"
        )
    if name == TWIN or name.rstrip("/").endswith(_ARCHIVE):
        other = archive if name == TWIN else MarkerArchive(name)
        if target not in other:
            raise LearningError(
                f"{other.name}: has no sensor {target!r}; allowed: --labels Y.markers.zarr, which "
                f"holds {target} with forces of its twin"
            )
        labels = simulated_labels(archive[sensors[0]], other[target])
        return LabelSource(by_twins(labels), (labels.made_from,), SIMULATED)
    file, _, choice = name.partition(":")
    wanted = choice or CHOICE_OF_METHOD["compensated"]
    stored = read_stored(Path(file)).pair(source, target, wanted)
    return LabelSource(
        compensated(stored),
        data=(weights_hash(Path(file)), f"{source}-to-{target}", choice),
        method=next(method for method, of in CHOICE_OF_METHOD.items() if of == wanted),
    )
