"""Training of all weights of the marker autoencoder and the translator, without published ones."""

from pathlib import Path

import torch
from support.tiny_diffusion import striped_pairs, tiny_pretrained, write_base
from support.training import session

from learning.config import read_settings
from learning.training.checkpoint import read_model_folder
from learning.training.run import RunFolder
from learning.translation.diffusion import train
from learning.translation.diffusion.network import KIND, load_vae_adapter
from learning.translation.diffusion.network import MARKER_VAE as VAE
from learning.translation.diffusion.train_vae import train_vae
from learning.translation.diffusion.translator import load_network
from learning.translation.diffusion.weights import BASE, fingerprint, read_unet, read_vae

FEW = (
    *("whole=true", "steps=3", "batch=2", "launch={device: cpu, mixed_precision: no}"),
    *("marker_vae.steps=3", "marker_vae.batch=2", "marker_vae.mixed_precision=no"),
)


def test_all_weights_are_trained_and_stored(tmp_path: Path) -> None:
    base = str(write_base(tmp_path / "base"))
    metadata = {BASE: fingerprint(base)}
    rate = "optimiser.rate={kind: constant, rate: 0.01}"
    given = [*FEW, f"weights.base={base}", rate, f"marker_vae.{rate}"]
    given += ["losses={adversarial: 0, perceptual: 0, square: 1}"]
    settings = read_settings(train.TranslatorSettings, train.PRESETS, "ours", given)
    own = settings.of_marker_vae()
    pairs = striped_pairs()
    run = RunFolder.open(tmp_path / "vae", VAE, own, "stripes", metadata=metadata)
    vae = train_vae(pairs.images, read_vae(base), own, None, session(own, run))
    begun = tiny_pretrained().vae.state_dict()
    moved = {name for name, each in vae.vae.state_dict().items() if not each.equal(begun[name])}
    assert moved == begun.keys()

    adapter = load_vae_adapter(tmp_path / "vae", fingerprint(base))
    assert adapter.keys() == begun.keys()
    networks = train.Pretrained(read_unet(base), read_vae(base))
    run = RunFolder.open(tmp_path / "m2m", KIND, settings, "stripes", metadata=metadata)
    running = session(settings, run)
    network = train.train(pairs, networks, settings, None, running, vae_adapter=adapter)
    # The reference encoder is the trained autoencoder's, and stays as it is.
    frozen = network.reference.encoder.state_dict()
    assert all(each.equal(adapter[f"encoder.{name}"]) for name, each in frozen.items())
    assert not network.vae.encoder.conv_in.weight.equal(adapter["encoder.conv_in.weight"])
    assert {name for name, _ in network.named_parameters()} - network.learning().keys() == {
        name for name, _ in network.named_parameters() if name.startswith("reference.")
    }

    read = load_network(read_model_folder(tmp_path / "m2m")).eval()
    images = torch.rand(2, 1, *pairs.images.shape[1:])
    latent = network.reference_posterior(images).mean
    with torch.no_grad():
        assert torch.equal(read(images, latent, latent), network(images, latent, latent))
