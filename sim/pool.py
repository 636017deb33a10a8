"""Worker processes of the simulator: how one of them is missed, and how many there may be."""

from recorder.processes import WorkerLost
from sim.tiers import check_processes

__all__ = ["WorkerLost", "check_processes"]
