"""The marker autoencoder: first stage of training, and what features of images are taken from.

autoencoder = load_autoencoder(folder, device)
autoencoder.features(images)  # uint8 (n, 256, 256) -> (n, 256) for the preset `ours`
"""

from learning.translation.autoencoder.loading import KIND, load_autoencoder
from learning.translation.autoencoder.network import Autoencoder

__all__ = ["KIND", "Autoencoder", "load_autoencoder"]
