"""Weights of the diffusion translator: the published ones and the authors' checkpoints."""

import copy
import functools
import os
import pickle
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from support.tiny_diffusion import (
    SIDE,
    tiny_pretrained,
    tiny_settings,
    write_base,
    write_judges,
)

from learning.errors import LearningError
from learning.training.checkpoint import read_model_folder, read_plain
from learning.translation.diffusion.authors import import_checkpoint
from learning.translation.diffusion.network import (
    UNET_TARGETS,
    VAE_TARGETS,
    MarkerToMarker,
    build,
    load_vae_adapter,
)
from learning.translation.diffusion.translator import load_network
from learning.translation.diffusion.weights import (
    fingerprint,
    read_clip,
    read_perceptual,
    read_unet,
    read_vae,
)
from tactile.__main__ import main


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_base(tmp_path_factory.mktemp("weights") / "sd-turbo")


@functools.cache
def _trained() -> MarkerToMarker:
    """Return a network whose adapters, tokens and first layer differ from the initial ones."""
    made = tiny_pretrained()
    network = build(made.unet, made.vae, tiny_settings("authors_code"))
    chance = torch.Generator().manual_seed(5)
    for each in network.state_dict().values():
        each.copy_(torch.randn(each.shape, generator=chance) * 0.1)
    return network


def _theirs(network: MarkerToMarker, vae_adapter: str = "ref_encoder_lora") -> dict[str, Any]:
    """Return a state dict as the authors' code saves it, by the description of its format."""

    def renamed(state: Mapping[str, torch.Tensor], adapter: str) -> dict[str, torch.Tensor]:
        return {name.replace("ref_encoder_lora", adapter): each for name, each in state.items()}

    state = network.state_dict()
    of: dict[str, dict[str, torch.Tensor]] = {"unet": {}, "vae": {}, "reference": {}, "tokens": {}}
    for key, each in state.items():
        part, _, name = key.partition(".")
        of[part][name] = each
    # Their autoencoder is complete: it also has the decoder's adapter.
    decoder = {name: each for name, each in of["vae"].items() if name.startswith("decoder.")}
    return {
        "unet_lora_target_modules": list(UNET_TARGETS),
        "vae_lora_target_modules": list(VAE_TARGETS),
        "ref_encoder_lora_target_modules": list(VAE_TARGETS),
        "rank_unet": 2,
        "rank_vae": 2,
        "rank_ref_encoder": 2,
        "state_dict_unet": of["unet"],
        "state_dict_vae": renamed(of["vae"], vae_adapter),
        "state_dict_ref_encoder": renamed({**of["reference"], **decoder}, vae_adapter),
    }


def test_networks_are_read_from_diffusers_layout(base: Path) -> None:
    published = tiny_pretrained()
    for read, expected in ((read_unet, published.unet), (read_vae, published.vae)):
        found = read(str(base)).state_dict()
        assert all(torch.equal(found[name], each) for name, each in expected.state_dict().items())


def test_an_old_autoencoders_names_of_attention_are_understood(base: Path, tmp_path: Path) -> None:
    shutil.copytree(base, tmp_path / "old")
    path = tmp_path / "old" / "vae" / "diffusion_pytorch_model.safetensors"
    new = {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}
    state = load_file(path)
    for name in list(state):
        for today, before in new.items():
            if f".{today}." in name:
                state[name.replace(f".{today}.", f".{before}.")] = state.pop(name)
    assert state.keys() != load_file(path).keys()
    save_file(state, path)
    assert (
        read_vae(str(tmp_path / "old")).state_dict().keys()
        == load_file(base / "vae" / "diffusion_pytorch_model.safetensors").keys()
    )


def test_what_is_missing_is_named_with_what_to_fetch(base: Path, tmp_path: Path) -> None:
    with pytest.raises(LearningError, match="needed: a folder of Stable Diffusion Turbo"):
        read_unet(str(tmp_path))
    with pytest.raises(LearningError, match=r"weights\.clip: found ''; needed: a folder of CLIP"):
        read_clip("")
    with pytest.raises(LearningError, match=r"vgg16-397923af\.pth"):
        read_perceptual("", "")
    shutil.copytree(base, tmp_path / "half")
    (tmp_path / "half" / "unet" / "diffusion_pytorch_model.safetensors").unlink()
    with pytest.raises(LearningError, match="found no weights; allowed: diffusion_pytorch_model"):
        read_unet(str(tmp_path / "half"))


def test_other_networks_weights_are_refused(base: Path, tmp_path: Path) -> None:
    shutil.copytree(base, tmp_path / "mixed")
    path = tmp_path / "mixed" / "vae" / "diffusion_pytorch_model.safetensors"
    shutil.copy(base / "unet" / "diffusion_pytorch_model.safetensors", path)
    with pytest.raises(LearningError, match="not the weights of this network: missing decoder"):
        read_vae(str(tmp_path / "mixed"))
    path.write_bytes(b"no weights")
    with pytest.raises(LearningError, match="corrupt or incomplete safetensors file"):
        read_vae(str(tmp_path / "mixed"))


def test_judges_are_read_from_their_published_layouts(tmp_path: Path) -> None:
    made, files = tiny_pretrained(), write_judges(tmp_path)
    texts = {"text_model.x": torch.ones(1), "logit_scale": torch.ones(1)}
    save_file({**made.clip.state_dict(), **texts}, tmp_path / "clip" / "model.safetensors")
    found = read_clip(str(files["clip"])).state_dict()
    assert all(torch.equal(found[name], each) for name, each in made.clip.state_dict().items())
    read = read_perceptual(str(files["vgg"]), str(files["lpips"]))
    images = torch.rand(2, 1, 3, 32, 32)
    assert torch.equal(read(*images), made.perceptual(*images))
    with pytest.raises(LearningError, match="missing features"):
        read_perceptual(str(tmp_path / "lpips.pth"), str(tmp_path / "lpips.pth"))


@pytest.mark.slow
def test_an_authors_translator_gives_the_same_network(base: Path, tmp_path: Path) -> None:
    torch.save(_theirs(_trained()), tmp_path / "model_11501.pkl")
    kind, count = import_checkpoint(tmp_path / "model_11501.pkl", str(base), tmp_path / "run")
    folder = read_model_folder(tmp_path / "run", "diffusion")
    network, expected = load_network(folder), _trained()
    assert kind == "diffusion"
    assert count == sum(each.numel() for each in expected.state_dict().values())
    assert network.pixel_range == "zero_one"
    images, latent = torch.rand(1, 1, SIDE, SIDE), torch.randn(1, 4, 4, 4)
    with torch.no_grad():
        torch.testing.assert_close(network(images, latent), expected(images, latent))
        for got, due in zip(
            (network.reference_posterior(images).mean, network.posterior(images).mean),
            (expected.reference_posterior(images).mean, expected.posterior(images).mean),
            strict=True,
        ):
            torch.testing.assert_close(got, due)


def test_an_authors_autoencoder_is_a_start_for_training(
    base: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    theirs = _theirs(_trained(), vae_adapter="marker_encoder")
    keys = ("vae_lora_target_modules", "rank_vae", "state_dict_vae")
    torch.save({key: theirs[key] for key in keys}, tmp_path / "checkpoint.pth")
    command = ["import", str(tmp_path / "checkpoint.pth"), "--base", str(base)]
    assert main([*command, "--out", str(tmp_path / "run")]) == 0
    assert "run: marker-vae, " in capsys.readouterr().out
    adapter = load_vae_adapter(tmp_path / "run", fingerprint(str(base)))
    own = {name.removeprefix("vae."): each for name, each in _trained().state_dict().items()}
    assert adapter
    assert all(torch.equal(each, own[name]) for name, each in adapter.items())


class _Harmful:
    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, ("harm",)


def test_pickles_that_would_run_code_are_refused_unread(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"state_dict_vae": _Harmful()}, tmp_path / "harmful.pkl")
    (tmp_path / "plain.pkl").write_bytes(pickle.dumps(_Harmful(), protocol=2))
    for name in ("harmful.pkl", "plain.pkl"):
        with pytest.raises(LearningError, match="is no file of weights"):
            read_plain(tmp_path / name)
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda theirs: theirs.update(rank_unet=8), "rank_unet: found 8; its tensors have 2"),
        (lambda theirs: theirs.update(vae_lora_target_modules=["conv"]), "vae_lora_target"),
        (lambda theirs: theirs.pop("state_dict_vae"), "state_dict_vae: missing"),
        (lambda theirs: theirs["state_dict_unet"].update(x=torch.ones(1)), "found 'x'"),
        (lambda theirs: theirs["state_dict_unet"].pop("conv_in.bias"), r"missing unet\.conv_in\.b"),
        (lambda theirs: theirs["state_dict_unet"]["conv_in.bias"].fill_(torch.nan), "not finite"),
    ],
)
def test_files_that_are_not_whole_are_refused_and_nothing_is_written(
    change: Any, message: str | None, base: Path, tmp_path: Path
) -> None:
    theirs = copy.deepcopy(_theirs(_trained()))
    change(theirs)
    torch.save(theirs, tmp_path / "model.pkl")
    with pytest.raises(LearningError, match=message):
        import_checkpoint(tmp_path / "model.pkl", str(base), tmp_path / "run")
    assert not (tmp_path / "run").exists()
