"""Marker-to-marker translation: predict the frames another sensor would show for the same press.

Three translators share one interface (`translator`): `flow` is classical and needs no training,
`field` and `diffusion` are trained; other packages offer more. `loading` opens a translator,
`archive` translates whole archives.
"""

from learning.translation.loading import load_translator
from learning.translation.translator import (
    FLOW,
    PairTranslator,
    SensorView,
    Translator,
    for_pair,
    require_masks,
)

__all__ = [
    "FLOW",
    "PairTranslator",
    "SensorView",
    "Translator",
    "for_pair",
    "load_translator",
    "require_masks",
]
