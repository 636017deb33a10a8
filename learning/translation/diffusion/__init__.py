"""The paper's translator: SD-Turbo's autoencoder and UNet with adapters, in a single step.

`train_vae` and `train` are its training stages, `load` opens a trained translator. The user
supplies the published weights; diffusers, peft and transformers are imported only when used.
"""

from learning.translation.diffusion.network import MarkerToMarker
from learning.translation.diffusion.translator import DiffusionTranslator, load

__all__ = ["DiffusionTranslator", "MarkerToMarker", "load"]
