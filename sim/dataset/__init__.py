"""Archives of simulated sensors: the paper's states, and its trajectories on our sensors.

A plan determines the contents of an archive and is stored in it. Its units can be made by one
process, by several, or by a cluster, in any order and more than once.
"""

from sim.dataset.plan import DatasetPlan, Solving, Unit, gel
from sim.dataset.run import OpenArchive, begin, fill, reopened

__all__ = ["DatasetPlan", "OpenArchive", "Solving", "Unit", "begin", "fill", "gel", "reopened"]
