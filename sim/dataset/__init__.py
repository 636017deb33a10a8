"""Archives of simulated sensors: the paper's states, and its trajectories on our sensors.

A plan determines the contents of an archive and is stored in it. Its units can be made by one
process, by several, or by a cluster, in any order and more than once.
"""

from sim.dataset.plan import DatasetPlan as DatasetPlan
from sim.dataset.plan import Solving as Solving
from sim.dataset.plan import Unit as Unit
from sim.dataset.plan import gel as gel
from sim.dataset.run import OpenArchive as OpenArchive
from sim.dataset.run import begin as begin
from sim.dataset.run import fill as fill
from sim.dataset.run import reopened as reopened
