"""The direct translator: a compact network that attends to the target's reference."""

from learning.translation.direct.network import DirectNetwork
from learning.translation.direct.translator import KIND, DirectTranslator, load, load_network

__all__ = ["KIND", "DirectNetwork", "DirectTranslator", "load", "load_network"]
