"""The learned field translator: displacement as a network sees it, and as another sensor shows it.

`train` is the training, `load` opens a trained model. Nets never draw a marker: they say how
the target's reference is to be deformed, so edges are as sharp as the reference's, and patterns
need not have been seen in training.
"""

from learning.translation.field.settings import FieldSettings
from learning.translation.field.translator import KIND, FieldModel, FieldTranslator, load

__all__ = ["KIND", "FieldModel", "FieldSettings", "FieldTranslator", "load"]
