"""Force models in Python, and the command `tactile`: its table, and one way to run and end it."""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from learning.force.tactile_model import Forces as Forces
    from learning.force.tactile_model import TactileModel as TactileModel
    from learning.force.tactile_model import load as load

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
