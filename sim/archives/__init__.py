"""Archives of simulated sensors: the paper's states, and its trajectories on sensors of ours.

A plan says what an archive holds; it is stored in the archive, and everything follows from it.
Units of it are made by one process, by several, or by a cluster, in any order and twice.
"""

from sim.archives.beginning import Begun, begin, found
from sim.archives.families import Family, Unit, families, units
from sim.archives.filling import Filled, fill
from sim.archives.making import Made, make_unit
from sim.archives.plan import UNSEEN, Plan
from sim.archives.solving import Solving
from sim.archives.states import gel
from sim.archives.stopping import Stop
from sim.archives.targets import chosen_targets

__all__ = [
    "UNSEEN",
    "Begun",
    "Family",
    "Filled",
    "Made",
    "Plan",
    "Solving",
    "Stop",
    "Unit",
    "begin",
    "chosen_targets",
    "families",
    "fill",
    "found",
    "gel",
    "make_unit",
    "units",
]
