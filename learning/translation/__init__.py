"""Marker-to-marker translation: predict the frames another sensor would show for the same press.

Three translators share one interface (`translator`): `flow` is classical and needs no training,
`field` and `diffusion` are trained; other packages offer more. `loading` opens a translator,
`archive` translates whole archives.
"""

from typing import TYPE_CHECKING

from recorder.on_demand import imports_on_demand

if TYPE_CHECKING:
    from learning.translation.loading import load_translator as load_translator
    from learning.translation.translator import FLOW as FLOW
    from learning.translation.translator import PairTranslator as PairTranslator
    from learning.translation.translator import SensorView as SensorView
    from learning.translation.translator import Translator as Translator
    from learning.translation.translator import for_pair as for_pair
    from learning.translation.translator import require_masks as require_masks

__getattr__, __dir__ = imports_on_demand(__name__, __file__)
