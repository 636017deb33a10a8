"""Force sensing from marker images, trained on recordings that `recorder` stores.

A public name is imported when it is first used: the data set needs PyTorch, most commands do not.
"""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from learning.data.dataset import TactileDataset as TactileDataset
    from learning.errors import LearningError as LearningError

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
