"""Arm trajectories as pure data: frozen specs that yield moves. No hardware, clock or files.

A spec is stored as JSON in the session recorded with it; its moves are derived again when needed.
"""

from trajectories.limits import DryRun as DryRun
from trajectories.limits import Limits as Limits
from trajectories.limits import dry_run as dry_run
from trajectories.limits import move_duration as move_duration
from trajectories.plans import PHASES as PHASES
from trajectories.plans import FirstPress as FirstPress
from trajectories.plans import ForceDepth as ForceDepth
from trajectories.plans import Move as Move
from trajectories.plans import Plan as Plan
from trajectories.plans import Point as Point
from trajectories.plans import PressShear as PressShear
from trajectories.plans import Taps as Taps
from trajectories.plans import Target as Target
from trajectories.plans import Touch as Touch
from trajectories.plans import dome_height as dome_height
from trajectories.plans import plan_from_json as plan_from_json
from trajectories.plans import plan_to_json as plan_to_json
from trajectories.squeeze import Squeeze as Squeeze
from trajectories.squeeze import SqueezeStep as SqueezeStep
