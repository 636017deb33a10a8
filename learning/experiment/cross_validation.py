"""Leave one indenter out: a model for each that was trained on the others, and a baseline."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from learning.data.presses import Presses, load_presses
from learning.errors import LearningError
from learning.evaluation.baseline import colour_features, fit_ridge
from learning.evaluation.predictions import BASELINE, TARGET, UNSEEN, Predictions, predictions_of
from learning.force.train import ForceModelSettings, train_force
from learning.metrics import force_errors
from recorder.archive import SHADING, MarkerArchive
from recorder.progress import ReportItems

Floats = NDArray[np.float64]
# Place of Fz among the axes of errors.
_FZ = 2
_AXES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Fold:
    """Predictions for the presses of one indenter by models that never saw it."""

    indenter: str
    predictions: tuple[Predictions, ...]
    """Those of the network, then those of the baseline where there is one."""

    def __str__(self) -> str:
        parts = []
        for one in self.predictions:
            errors = force_errors(one.true, one.predicted, one.label_std)
            off = errors.mae[_FZ]
            normal = f", MAE Fz {off:.2f} N" if np.isfinite(off) else ""
            parts.append(f"{one.method} R2{errors.of_axes} {errors.r2_mean:.3f}{normal}")
        return f"{self.indenter} left out: {'; '.join(parts)}"


def folds(
    archive: MarkerArchive, sensor: str, settings: ForceModelSettings, progress: ReportItems
) -> Iterator[Fold]:
    """Train and predict with each indenter of a labelled sensor left out in turn.

    The number of epochs is that of the settings: no press of the indenter that is left out chooses
    anything.
    """
    one = archive[sensor]
    table = one.table
    usable = table["valid"] & (table["location"] >= 0)
    labelled = usable & np.isfinite(table["wrench"][:, :3]).any(axis=1)
    codes = np.unique(table["indenter"][labelled])
    if len(codes) < 2:
        raise LearningError(
            f"{sensor}: found labels on {len(codes)} indenters; allowed: two or more, as one is "
            "left out"
        )
    form = settings.input.stored_form
    for done, code in enumerate(codes.tolist()):
        progress(done, len(codes))
        held = np.flatnonzero(usable & (table["indenter"] == code))
        training_rows = np.flatnonzero(labelled & (table["indenter"] != code))
        training, test = (load_presses(one, rows, form=form) for rows in (training_rows, held))
        model = train_force(training, replace(settings, patience_epochs=None))
        forces: list[tuple[str, Floats]] = [(TARGET, model.predict(test))]
        if one.representation == SHADING:
            forces.append((BASELINE, ridge_forces(training, test)))
        rows = test.rows.numpy()
        predictions = tuple(
            predictions_of(
                one,
                archive.indenters,
                rows,
                np.full(len(rows), UNSEEN),
                predicted,
                source=sensor,
                method=method,
                translator="",
                model="one for each indenter left out",
            )
            for method, predicted in forces
        )
        yield Fold(archive.indenters[code], predictions)
    progress(len(codes), len(codes))


def ridge_forces(training: Presses, test: Presses) -> Floats:
    """Return forces (n, 3) N by ridge regression on features of colours; NaN without labels."""
    training_features = colour_features(training.images.cpu().numpy())
    test_features = colour_features(test.images.cpu().numpy())
    labels = training.wrench[:, :3].cpu().numpy().astype(np.float64)
    groups = training.of_frame.tolist()
    forces = np.full((len(test_features), _AXES), np.nan)
    for axis in range(_AXES):
        if np.isfinite(labels[:, axis]).any():
            ridge = fit_ridge(training_features, labels[:, axis], groups)
            forces[:, axis] = ridge.predict(test_features)
    return forces
