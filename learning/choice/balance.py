"""Labels of a finger by balance: from the other finger's model, or from known weights alone."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.choice.nested import folds_of
from learning.choice.run import Origin, Request, Say
from learning.data.matching import SensorSelection
from learning.data.presses import Form, load_presses
from learning.errors import LearningError
from learning.force.calibrate import shapes
from learning.force.closed_form import features_of, ridge
from learning.force.folder import model_name
from learning.force.intervals import AxisError, Scale, read_intervals
from learning.force.labels import LabelSource, Relabelling
from learning.force.loading import load_force_model
from learning.force.made_for import CHOICE, made_for
from learning.training.checkpoint import read_config
from learning.transfer.scale import forces_at
from learning.transfer.squeezes import Squeezes, squeezes
from learning.transfer.weights import Balanced, forces_by, straight, weigh_balanced
from recorder.archive import MASKS

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Rounds in which either finger learns the other's force, penalty of its regression, and folds.
ROUNDS, PENALTY, FOLDS = 4, 0.003, 8
# Columns of `statistics` whose mean is the first signal.
STEPS = slice(3, 6)
NORMAL_ALONE = (
    "Fx and Fy are unknown (NaN): balance is along the grip axis; how fingers divide a weight "
    "across it does not follow"
)
INTERPOLATED = (
    "the curve of force is interpolated from one held step to the next; the intervals do not "
    "contain a sudden bend there"
)


def by_model(one: Request, source: SensorSelection, model: str, say: Say) -> Origin:
    """Return labels by the forces that a model predicts on the source, the other finger.

    Raises:
        LearningError: The model has no interval of Fz or is of another sensor, or no frames pair.
    """
    pairs = squeezes(one.sensor, source, one.unseen)
    folder = Path(model_name(model))
    intervals = read_intervals(folder)
    if intervals is None or (axis := intervals.axes[2]) is None:
        raise LearningError(
            f"--source-model: found no interval of Fz in {folder}; allowed: one of `tactile force`"
        )
    names = [each.sensor for each in made_for(folder)]
    if source.name not in names:
        raise LearningError(
            f"--source-model: found a model of {', '.join(names)}; allowed: one of {source.name}, "
            f"or --source {source.archive.name}:{source.sensor}=NAME, the model's name of it"
        )
    of = read_config(folder).metadata.get(CHOICE, {}).get("finger")
    if of and of != source.archived.attrs.get("finger"):
        raise LearningError(
            f"--source-model: found a model of the {of} finger; allowed: one of "
            f"{source.archived.attrs.get('finger')}, whose archive is the source"
        )
    rows, back = np.unique(pairs.others, return_inverse=True)
    predicted = forces_at(source.archived, rows, load_force_model(folder))
    held, forces = pairs.step > 0, predicted[back]
    unlike = intervals.is_outside(predicted, shapes(source.archived, rows))[back] & held
    used = held & ~unlike
    if not used.any():
        raise LearningError(
            "--source-model: found squeezes unlike all that it learned; allowed: some like those"
        )
    say(f"{used.sum():,} frames labelled; unlike those that the model learned: {unlike.sum():,}")
    # Its error grows with its whole force, of which the labels have Fz alone.
    sizes = np.sqrt(np.nansum(np.square(forces[used]), axis=1))
    slope = axis.slope * float(sizes.sum() / np.abs(forces[used, 2]).sum())
    fz = np.where(held, forces[:, 2] - pairs.weight, 0.0)
    fz[unlike] = np.nan
    text = f"forces of {source.name}'s model, less the weight"
    scale = replace(intervals.scale, source=f"{text}: {intervals.scale.source}")
    known = {"scale": scale, "error": AxisError(axis.base, slope), "notes": (NORMAL_ALONE,)}
    return _origin(one, source, pairs, fz, text, **known)


def by_weights(one: Request, source: SensorSelection, say: Say) -> Origin:
    """Return labels by balance and known weights alone; neither finger has a model or a label.

    In turn a regression of either finger learns the force that the other one's line and the weight
    give it; its predictions on objects left out are the finger's next signal. Shapes that one
    finger alone touches do not help to predict the other's force, so they go.

    Raises:
        LearningError: Too few weights or steps, or no frames pair.
    """
    pairs = squeezes(one.sensor, source, one.unseen)
    if (pairs.step > 0).all():
        raise LearningError(
            f"{one.sensor.sensor}: found no still frame at step 0; allowed: some without contact"
        )
    fingers = _features(one, one.sensor, pairs.rows), _features(one, source, pairs.others)
    signals = _from_rest(pairs, [features[:, STEPS].mean(axis=1) for features in fingers])
    for _ in range(ROUNDS):
        factors = straight(_balanced(pairs, signals))
        both = zip(fingers, _by_other(pairs, factors[:, None] * signals), strict=True)
        signals = _from_rest(pairs, [_learned(*each, pairs.indenter, one.seed) for each in both])
    weighed = weigh_balanced(_balanced(pairs, signals))
    force, half = weighed.forces[1], weighed.half_width[1]
    for at in np.array([0.2, 0.5, 0.8]) * force[-1]:
        width = 100 * float(np.interp(at, force, half / force))
        say(f"forces of {at:.2f} N by weights: +- {width:.1f} % at 90 %")
    largest = f"{np.abs(pairs.weight).max():.2f} N along the grip axis"
    text = f"balance with {source.name} and weights of up to {largest}"
    fz = -_by_other(pairs, forces_by(weighed.curves, signals))[0]
    known = {"error": weighed.error(1), "notes": (NORMAL_ALONE, INTERPOLATED)}
    return _origin(one, source, pairs, fz, text, scale=Scale(1.0, text, assumed=False), **known)


def _origin(
    one: Request, source: SensorSelection, pairs: Squeezes, fz: Floats, text: str, **known: Any
) -> Origin:
    """Return Fz of pairs (n,) [N] as labels of the sensor's rows; NaN elsewhere."""
    forces = np.full((len(one.sensor.archived), 3), np.nan)
    forces[pairs.rows, 2] = fz
    digest = hashlib.sha256(forces.tobytes()).hexdigest()
    labels = LabelSource(Relabelling(lambda rows, *_: forces[rows]), ("balance", digest))
    return Origin(labels, errors_from=text, method="transferred", source=source.name, **known)


def _by_other(pairs: Squeezes, forces: Floats) -> Floats:
    """Return the force of either finger (2, n) [N] by that of the other (2, n) and the weight."""
    return np.where(pairs.step > 0, (forces[1] + pairs.weight, forces[0] - pairs.weight), 0.0)


def _from_rest(pairs: Squeezes, signals: list[Floats]) -> Floats:
    """Return signals (2, n) less those without contact."""
    return np.stack([signal - signal[pairs.step == 0].mean() for signal in signals])


def _balanced(pairs: Squeezes, signals: Floats) -> Balanced:
    held = pairs.step > 0
    return Balanced(signals[:, held], pairs.weight[held], pairs.step[held], pairs.indenter[held])


def _features(one: Request, finger: SensorSelection, rows: Integers) -> Floats:
    """Return statistics of a finger's frames with their squares and roots (n, 33)."""
    form: Form = "field" if finger.archived.representation == MASKS else "shading"
    place, valid = (finger.archived.table[name] for name in ("location", "valid"))
    frames = np.flatnonzero(np.isin(place, place[rows]) & valid)
    presses = load_presses(finger.archived, frames, device=one.device, form=form)
    order = np.argsort(presses.rows.numpy())[np.searchsorted(frames, rows)]
    own = features_of(presses, "statistics").numpy()[order]
    return np.hstack([own, own**2, np.sqrt(np.abs(own))])


def _learned(features: Floats, forces: Floats, objects: Integers, seed: int) -> Floats:
    """Return the force of each frame (n,) [N] by a regression on the others' objects."""
    predicted = np.zeros(len(forces))
    for fold in folds_of(np.unique(objects).tolist(), seed, FOLDS):
        inside = np.isin(objects, sorted(fold))
        mean, scale = features[~inside].mean(axis=0), features[~inside].std(axis=0)
        standard = (features - mean) / np.where(scale > 0, scale, 1.0)
        own = standard[~inside]
        ((weights, offset),) = ridge(own, forces[~inside, None], (PENALTY,))
        near = standard[inside].clip(own.min(axis=0), own.max(axis=0))
        predicted[inside] = (near @ weights + offset)[:, 0]
    return predicted
