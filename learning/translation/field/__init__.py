"""The learned field translator: networks that predict how to deform the target's reference.

`train` trains a model, `load` opens a trained one. The networks never draw markers, they deform the
target's reference. Edges are therefore as sharp as in the reference, and patterns need not have
been seen in training.
"""

from learning.translation.field.network import FieldModel
from learning.translation.field.translator import FieldTranslator, load

__all__ = ["FieldModel", "FieldTranslator", "load"]
