"""The classical translator: markers are followed, and what they did is done to the target's.

No training. It is exact as far as both sensors' skins move alike and markers are near enough to
each other to say how: a field between them is a smooth guess.
"""

from learning.translation.flow.fields import LATTICE, MAP_SIDE, FieldReader, marker_fields
from learning.translation.flow.translator import FlowTranslator

__all__ = [
    "LATTICE",
    "MAP_SIDE",
    "FieldReader",
    "FlowTranslator",
    "marker_fields",
]
