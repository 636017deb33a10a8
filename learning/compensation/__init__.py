"""Material compensation: labels of one skin brought to the stiffness of another (eq. 7 to 9).

Priors say how hard a flat indenter has to press each sensor to a depth; their ratio scales the
labels that a force model of the target is trained on.
"""

from learning.compensation.fit import PairCompensation, StoredCompensation, read_stored
from learning.compensation.prior import (
    DEFAULT_D0,
    DEFAULT_WEIGHT,
    Branch,
    ForceDepth,
    Prior,
    compensate,
    curve_of_session,
    curve_of_table,
    fit_prior,
    prior_of_coefficients,
)
from learning.compensation.search import Choice, Grid, Paired, best_for_labels, best_for_priors

__all__ = [
    "DEFAULT_D0",
    "DEFAULT_WEIGHT",
    "Branch",
    "Choice",
    "ForceDepth",
    "Grid",
    "PairCompensation",
    "Paired",
    "Prior",
    "StoredCompensation",
    "best_for_labels",
    "best_for_priors",
    "compensate",
    "curve_of_session",
    "curve_of_table",
    "fit_prior",
    "prior_of_coefficients",
    "read_stored",
]
