"""The paper's translator: SD-Turbo's autoencoder and UNet with adapters, in one step.

`train_vae` and `train` are its stages, `load` is what it becomes. The published weights are the
user's; diffusers, peft and transformers are needed only when one of them is called.
"""

from learning.translation.diffusion.network import MarkerToMarker
from learning.translation.diffusion.settings import TranslatorSettings
from learning.translation.diffusion.translator import KIND, DiffusionTranslator, load

__all__ = ["KIND", "DiffusionTranslator", "MarkerToMarker", "TranslatorSettings", "load"]
