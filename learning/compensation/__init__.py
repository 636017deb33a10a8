"""Material compensation: scaling labels of one skin to the stiffness of another (eq. 7 to 9).

A prior is the force with which a flat indenter presses a sensor to a given depth. The ratio of two
priors scales the labels on which a force model of the target is trained.
"""

from learning.compensation.fit import (
    CHOICE_OF_METHOD,
    PairCompensation,
    StoredCompensation,
    read_stored,
)
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
from learning.compensation.search import Choice, Paired, best_for_labels, best_for_priors
from learning.compensation.simulated import (
    SIMULATED,
    simulated_labels,
    simulated_r2,
    twin_forces,
)

__all__ = [
    "CHOICE_OF_METHOD",
    "DEFAULT_D0",
    "DEFAULT_WEIGHT",
    "SIMULATED",
    "Branch",
    "Choice",
    "ForceDepth",
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
    "simulated_labels",
    "simulated_r2",
    "twin_forces",
]
