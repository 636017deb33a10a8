"""Archives of simulated sensors: the paper's states, and its trajectories on our sensors.

A plan determines the contents of an archive and is stored in it. Its units can be made by one
process, by several, or by a cluster, in any order and more than once.
"""

from sim.dataset.generate import make_unit
from sim.dataset.plan import (
    UNSEEN,
    DatasetPlan,
    Family,
    Solving,
    Unit,
    chosen_targets,
    families,
    gel,
    units,
)
from sim.dataset.run import (
    OpenArchive,
    begin,
    fill,
    found,
    make_here,
    make_in_processes,
)

__all__ = [
    "UNSEEN",
    "DatasetPlan",
    "Family",
    "OpenArchive",
    "Solving",
    "Unit",
    "begin",
    "chosen_targets",
    "families",
    "fill",
    "found",
    "gel",
    "make_here",
    "make_in_processes",
    "make_unit",
    "units",
]
