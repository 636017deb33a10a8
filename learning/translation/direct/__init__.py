"""The direct translator: a compact network that attends to the target's reference."""

from learning.translation.direct.network import DirectNetwork
from learning.translation.direct.train import KIND, load_network
from learning.translation.direct.translator import DirectTranslator, load

__all__ = ["KIND", "DirectNetwork", "DirectTranslator", "load", "load_network"]
