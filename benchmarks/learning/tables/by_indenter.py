"""What each unseen indenter adds to the errors of force."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from learning.evaluation.predictions import UNSEEN, Predictions
from learning.metrics import force_errors, r_squared
from recorder.strict_yaml import natural_key

Variant = tuple[str, str]
"""Method and translator."""


@dataclass(frozen=True, slots=True)
class IndenterErrors:
    """Errors on frames of one indenter; means over pairs."""

    indenter: str
    """Its name."""
    reach: float
    """Largest normal force of the labels, in any sensor [N]."""
    shear: float
    """Mean absolute error of Fx and Fy [N]."""
    normal: float
    """Mean absolute error of Fz [N]."""
    r2_of_others: float
    """R2 of all unseen indenters but this one, mean over axes; NaN where there is no other."""


def by_indenter(
    predictions: Iterable[Predictions],
) -> Mapping[Variant, tuple[IndenterErrors, ...]]:
    """Return the errors of each variant by unseen indenter, those of the largest forces first.

    Args:
        predictions: Of any pairs and roles, each pair and variant in one.
    """
    variants: dict[Variant, list[Predictions]] = {}
    for one in predictions:
        unseen = one.only(one.role == UNSEEN)
        if len(unseen):
            variants.setdefault((one.method, one.translator), []).append(unseen)
    return {variant: _of_pairs(some) for variant, some in variants.items()}


def _of_pairs(pairs: Sequence[Predictions]) -> tuple[IndenterErrors, ...]:
    names = {str(name) for one in pairs for name in one.indenter}
    found = (_of_indenter(name, pairs) for name in names)
    return tuple(sorted(found, key=lambda one: (-one.reach, natural_key(one.indenter))))


def _of_indenter(name: str, pairs: Sequence[Predictions]) -> IndenterErrors:
    reach, shear, normal, others = [], [], [], []
    for one in pairs:
        own = one.indenter == name
        if own.any():
            errors = force_errors(one.true[own], one.predicted[own], one.label_std)
            reach.append(float(np.abs(one.true[own, 2]).max()))
            shear.append(errors.shear)
            normal.append(errors.mae[2])
        if not own.all():
            others.append(float(r_squared(one.true[~own], one.predicted[~own]).mean()))
    left = float(np.mean(others)) if others else float("nan")
    return IndenterErrors(name, max(reach), float(np.mean(shear)), float(np.mean(normal)), left)
