"""The diffusion translator's network: its single step, its tokens, and its trainable parameters."""

import ast
import copy
import functools
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from support.tiny_diffusion import SIDE, striped_pairs, tiny_pretrained, tiny_settings
from torch import nn

from benchmarks.paper import full_size
from learning.config import read_settings
from learning.data.images import unit
from learning.errors import LearningError
from learning.translation.diffusion.discriminator import ClipFeatures, DiscriminatorHeads
from learning.translation.diffusion.network import (
    UNET_ADAPTER,
    UNET_TARGETS,
    VAE_ADAPTER,
    VAE_TARGETS,
    MarkerToMarker,
    ReferenceTokens,
    add_adapter,
    build,
    clean_latent,
    is_adapter,
    native,
    remaining_signal,
    sine_places,
)
from learning.translation.diffusion.train import PRESETS, TranslatorSettings, train
from learning.translation.diffusion.weights import WIDTHS, vendor
from tests.support.few import few

pytestmark = pytest.mark.slow

LEARNING = Path(__file__).parents[2] / "learning"


@functools.cache
def _network(preset: str = "ours") -> MarkerToMarker:
    """Return a network that tests do not modify."""
    made = tiny_pretrained()
    return build(made.unet, made.vae, tiny_settings(preset))


def test_one_step_is_that_of_ddpm_with_trailing_spacing() -> None:
    scheduler = vendor("diffusers").DDPMScheduler(
        beta_schedule="scaled_linear", beta_start=0.00085, beta_end=0.012,
        timestep_spacing="trailing", clip_sample=False,
    )  # fmt: skip
    scheduler.set_timesteps(1)
    noisy, noise = torch.randn(2, 3, 4, 5, 6, generator=torch.Generator().manual_seed(1))
    stepped = scheduler.step(noise, int(scheduler.timesteps[0]), noisy).prev_sample
    assert scheduler.timesteps.tolist() == [999]
    torch.testing.assert_close(clean_latent(noisy, noise), stepped, rtol=1e-4, atol=1e-4)
    assert remaining_signal() == pytest.approx(0.00466, abs=1e-5)


def test_one_step_is_computed_in_float32_under_autocast() -> None:
    noisy, noise = torch.randn(2, 1, 4, 2, 2).bfloat16()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = clean_latent(noisy, noise)
    assert torch.equal(found, clean_latent(noisy.float(), noise.float()))


@pytest.mark.parametrize(
    ("kind", "width", "count"), [("channel_tokens", 1024, 4), ("patch_tokens", 24, 256)]
)
def test_a_reference_becomes_so_many_tokens_and_two_twice_as_many(kind, width, count):
    for references in (1, 2):
        tokens = ReferenceTokens(kind, channels=4, width=width, source_reference=references == 2)
        latents = torch.randn(references, 2, 4, 32, 32)
        assert tokens(*latents).shape == (2, count * references, width)


def test_channel_tokens_are_the_authors_view_and_fit_one_size_only() -> None:
    tokens = ReferenceTokens("channel_tokens", channels=4, width=16, source_reference=False)
    latent = torch.randn(2, 4, 4, 4)
    assert torch.equal(tokens(latent), latent.view(2, -1, 16))
    assert not list(tokens.parameters())
    with pytest.raises(LearningError, match="8 x 4; allowed: 16 pixels"):
        tokens(torch.randn(1, 4, 8, 4))


def test_a_source_reference_is_needed_where_it_is_read_and_refused_where_not() -> None:
    latent = torch.randn(1, 4, 4, 4)
    reads = ReferenceTokens("patch_tokens", channels=4, width=8, source_reference=True)
    with pytest.raises(LearningError, match="source_reference: missing"):
        reads(latent)
    reads_none = ReferenceTokens("patch_tokens", channels=4, width=8, source_reference=False)
    with pytest.raises(LearningError, match="reads none"):
        reads_none(latent, latent)


def test_no_two_places_have_the_same_code() -> None:
    places = sine_places(16, 16, 64)
    apart = torch.cdist(places, places) + 10 * torch.eye(256)
    assert float(apart.min()) > 0.5


def test_a_new_network_decodes_as_the_published_one_since_adapters_begin_at_nothing() -> None:
    published = tiny_pretrained().vae
    network = _network()
    images = unit(striped_pairs().images[:2])
    scaled = native(images, network.pixel_range)
    with torch.no_grad():
        expected = published.encode(scaled).latent_dist.mean * 0.18215
        torch.testing.assert_close(network.posterior(images).mean, expected)
        torch.testing.assert_close(network.reference_posterior(images).mean, expected)


def test_images_are_translated_to_images_of_their_size() -> None:
    network = _network()
    latent = torch.randn(2, 4, 4, 4)
    made = network(torch.rand(2, 1, SIDE, SIDE), latent, latent)
    assert made.shape == (2, 3, SIDE, SIDE)
    assert float(made.detach().abs().max()) <= 1
    assert network.grey(made).dtype == torch.uint8


def test_grey_levels_come_back_from_either_range() -> None:
    images = unit(torch.arange(256, dtype=torch.uint8).view(1, 16, 16))
    for pixel_range, black in (("minus_one_one", -1), ("zero_one", 0)):
        network = copy.copy(_network())
        network.pixel_range = pixel_range
        scaled = native(images, pixel_range)
        assert torch.equal(network.grey(scaled), (images * 255)[:, 0].byte())
        assert (float(scaled.min()), float(scaled.max())) == (black, 1)


@pytest.mark.parametrize("preset", few(["ours", "authors_code"], 1))
def test_all_that_is_meant_to_learn_learns_and_nothing_else_moves(preset: str) -> None:
    settings = tiny_settings(preset)
    # Without weight decay, parameters without a gradient do not change. The first halves of
    # adapters have a gradient once the second halves are no longer 0: from the second step on.
    still = replace(settings.optimiser, weight_decay=0.0)
    settings = replace(settings, optimiser=still, steps=2, batch=1)
    made, fresh = tiny_pretrained(), tiny_pretrained()
    begun = build(fresh.unet, fresh.vae, settings)
    before = {name: each.clone() for name, each in begun.named_parameters()}
    judges = {name: each.clone() for name, each in _judges(made)}
    network = train(striped_pairs(), made, settings)
    moved = {
        name for name, each in network.named_parameters() if not torch.equal(each, before[name])
    }
    # In the authors' code no optimiser contains the autoencoder's adapter.
    adapted = ("unet.", "vae.") if preset == "ours" else ("unet.",)
    assert moved == {
        name
        for name in before
        if name.startswith(("tokens.", "unet.conv_in."))
        or (is_adapter(name) and name.startswith(adapted))
    }
    assert any(name.startswith("reference.") for name in before)
    assert all(torch.equal(each, judges[name]) for name, each in _judges(made))


def _judges(made: object) -> list[tuple[str, torch.Tensor]]:
    both = nn.ModuleDict({"clip": made.clip, "perceptual": made.perceptual})  # type: ignore[attr-defined]
    return list(both.named_parameters())


def test_state_is_what_the_published_weights_do_not_hold_and_goes_back() -> None:
    network = _network()
    state = {name: each.clone() for name, each in network.state_dict().items()}
    assert {name.split(".")[0] for name in state} == {"unet", "vae", "reference", "tokens"}
    assert not [name for name in state if ".base_layer." in name]
    changed = {name: each + 1 for name, each in state.items()}
    network.load_state_dict(changed)
    assert all(torch.equal(each, changed[name]) for name, each in network.state_dict().items())
    network.load_state_dict(state)
    lacking = dict(list(changed.items())[1:])
    with pytest.raises(RuntimeError, match="Missing key"):
        network.load_state_dict(lacking)


def test_learning_does_not_import_the_diffusion_extra_before_it_is_needed() -> None:
    vendors = {"diffusers", "peft", "transformers", "torchvision"}
    texts = {path: path.read_text() for path in LEARNING.rglob("*.py")}
    named = {path: text for path, text in texts.items() if any(each in text for each in vendors)}
    assert named
    for path, text in named.items():
        for node in ast.parse(text).body:
            names = [each.name for each in getattr(node, "names", [])]
            module = getattr(node, "module", None) or ""
            roots = {name.split(".")[0] for name in (*names, module)}
            if isinstance(node, ast.Import | ast.ImportFrom):
                assert not roots & vendors, path


def test_a_missing_extra_is_said_with_how_to_install_it(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(LearningError, match=r"pip install 'tactile-rig\[diffusion\]'"):
        vendor("diffusers")


def test_full_size_networks_have_the_published_numbers_of_parameters() -> None:
    diffusers = vendor("diffusers")
    with torch.device("meta"):
        unet = diffusers.UNet2DConditionModel.from_config(full_size.UNET)
        vae = diffusers.AutoencoderKL.from_config(full_size.VAE)
        assert _count(unet) == pytest.approx(865.9e6, abs=0.1e6)
        assert _count(vae) == pytest.approx(83.65e6, abs=0.01e6)
        add_adapter(unet, UNET_ADAPTER, 8, UNET_TARGETS)
        add_adapter(vae, VAE_ADAPTER, 4, VAE_TARGETS)
    adapted = [each for name, each in unet.named_parameters() if ".lora_A." in name]
    assert len(adapted) == 257
    assert _count(unet, adapter=True) == pytest.approx(8.11e6, abs=0.01e6)
    assert _count(vae, adapter=True) == pytest.approx(0.88e6, abs=0.01e6)


@pytest.mark.parametrize("preset", ["ours", "authors_code"])
def test_full_size_networks_fit_together_at_256_px(preset: str) -> None:
    settings = read_settings(TranslatorSettings, PRESETS, preset)
    made = full_size.random_pretrained(
        full_size.UNET, full_size.VAE, full_size.CLIP, WIDTHS, "meta"
    )
    with torch.device("meta"):
        network = build(made.unet, made.vae, settings)
        images = torch.rand(2, 1, 256, 256)
        latent = network.reference_posterior(images).mean
        given = (latent, latent) if settings.source_reference else (latent,)
        translated = network(images, *given)
        judged = DiscriminatorHeads(768, 512)(ClipFeatures(made.clip)(translated))
        assert latent.shape == (2, 4, 32, 32)
        assert translated.shape == (2, 3, 256, 256)
        assert [tuple(each.shape) for each in judged] == [(2, 1, 4, 4), (2, 1, 4, 4), (2, 1)]
        assert made.perceptual is not None
        assert made.perceptual(translated, translated).shape == (2,)


def _count(network: nn.Module, adapter: bool = False) -> int:
    return sum(
        each.numel() for name, each in network.named_parameters() if is_adapter(name) or not adapter
    )
