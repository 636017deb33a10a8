"""Three-axis force from sequences of marker images: network, training, ONNX export, live use.

`learning.force.train.train_force` trains a model, `load_force_model` opens one, and
`learning.force.stream` runs an exported one frame by frame, without torch.
"""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from learning.force.authors import import_force_weights as import_force_weights
    from learning.force.export import export_onnx as export_onnx
    from learning.force.live import open_live as open_live
    from learning.force.loading import load_force_model as load_force_model
    from learning.force.model import ForceModel as ForceModel
    from learning.force.stream import ForceStream as ForceStream
    from learning.force.stream import open_exported as open_exported

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
