"""Training of the diffusion translator and of its autoencoder."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from support.tiny_diffusion import (
    SIDE,
    striped_pairs,
    tiny_pretrained,
    tiny_settings,
    tiny_vae_settings,
)
from support.training import session

from learning.errors import LearningError
from learning.training.run import METRICS, LaunchSettings, RunFolder, accelerator
from learning.translation.diffusion import train as translator
from learning.translation.diffusion.discriminator import ClipFeatures, DiscriminatorHeads
from learning.translation.diffusion.network import MarkerVae, build, vae_adapter_of
from learning.translation.diffusion.train import (
    IMAGES_PER_S,
    MEMORY_GIB,
    DiffusionLossWeights,
    train,
)
from learning.translation.diffusion.train_vae import train_vae

# Values of the log that differ between two runs of the same training.
COST = (IMAGES_PER_S, MEMORY_GIB)


def same_in_halves(folder: Path, settings: Any, training: Callable[[Any], Any]) -> Any:
    """Train two steps, and again with a stop between them: bit for bit the same network."""
    networks, logs = [], []
    for name, stops in (("whole", (2,)), ("halves", (1, 2))):
        for stop in stops:
            run = RunFolder.open(folder / name, "made up", settings, "x")
            networks.append(training(session(settings, run, 1 if stop == 1 else 0)))
            assert run.finished == (stop == 2)
        lines = (folder / name / METRICS).read_text().splitlines()
        logs.append([{k: v for k, v in json.loads(x).items() if k not in COST} for x in lines])
    whole, _, halves = (network.state_dict() for network in networks)
    assert logs[0] == logs[1]
    assert all(torch.equal(whole[name], each) for name, each in halves.items())
    return networks[0]


@pytest.mark.slow
def test_a_resumed_run_is_the_same_run_bit_for_bit(tmp_path: Path) -> None:
    settings = replace(tiny_settings(), accumulation=2, steps=2, batch=1)
    same_in_halves(
        tmp_path,
        settings,
        lambda session: train(striped_pairs(), tiny_pretrained(), settings, session=session),
    )


@pytest.mark.slow
def test_both_ways_of_a_step_follow_the_same_losses() -> None:
    logs = []
    for two_pass in (False, True):
        settings = replace(tiny_settings(), steps=1, two_pass=two_pass)
        listening = Mock()
        listening.restore.return_value = 0
        listening.log.side_effect = lambda step, values: logs.append(dict(values))
        running = replace(session(settings), run=listening)
        train(striped_pairs(), tiny_pretrained(), settings, session=running)
    one, two = logs
    assert one.keys() == two.keys()
    for name in ("train/square", "train/perceptual"):
        assert two[name] == pytest.approx(one[name], rel=1e-5)


def test_the_discriminator_does_not_learn_from_the_generators_loss() -> None:
    clip = tiny_pretrained().clip
    heads = DiscriminatorHeads(clip.config.hidden_size, clip.config.projection_dim)
    side = translator.Trainable(heads, torch.optim.AdamW(heads.parameters()))
    adversary = translator.Adversary(ClipFeatures(clip), side)
    runs_on = accelerator(LaunchSettings(device="cpu"))
    step = translator.TrainingStep(runs_on, DiffusionLossWeights(), 1.0, side, None, adversary)
    made = (torch.rand(1, 3, SIDE, SIDE) * 2 - 1).requires_grad_()
    nothing = torch.zeros(1)
    batch = translator.TranslationBatch(nothing, nothing, nothing, None, None, torch.Generator())
    step.fooling(made, batch, adversary).backward()
    assert made.grad is not None
    assert float(made.grad.abs().sum()) > 0
    assert all(each.grad is None and each.requires_grad for each in heads.parameters())


def test_a_translator_starts_from_the_trained_autoencoder_in_all_three_places() -> None:
    images = striped_pairs().images
    few = tiny_vae_settings("vae_rank=3", "marker_vae.steps=1")
    adapter = vae_adapter_of(train_vae(images, tiny_pretrained().vae, few).state_dict())
    made = tiny_pretrained()
    state = build(made.unet, made.vae, tiny_settings(), vae_adapter=adapter).state_dict()
    assert any(float(each.abs().max()) > 0 for name, each in adapter.items() if "lora_B" in name)
    for name, each in adapter.items():
        assert torch.equal(state[f"vae.{name}"], each)
        if name.startswith("encoder."):
            assert torch.equal(state[f"reference.{name}"], each)


@pytest.mark.slow
def test_the_autoencoder_resumes_exactly_and_only_its_adapter_learns(tmp_path: Path) -> None:
    settings = tiny_vae_settings("marker_vae.accumulation=2", "marker_vae.steps=2")
    images = striped_pairs().images
    network = same_in_halves(
        tmp_path,
        settings,
        lambda session: train_vae(images, tiny_pretrained().vae, settings, images[:2], session),
    )
    trained = network.state_dict()
    fresh = dict(tiny_pretrained().vae.named_parameters())
    kept = {
        name.replace(".base_layer", ""): each
        for name, each in network.vae.named_parameters()
        if ".lora_" not in name
    }
    assert all(torch.equal(each, fresh[name]) for name, each in kept.items())
    begun = MarkerVae(tiny_pretrained().vae, settings).state_dict()
    assert not [name for name, each in begun.items() if torch.equal(each, trained[name])]
    line = json.loads((tmp_path / "whole" / METRICS).read_text().splitlines()[-1])
    assert "validation/loss" in line


def test_the_authors_decoder_is_given_scaled_latents() -> None:
    images = torch.rand(1, 1, SIDE, SIDE)
    plain, scaled = (
        MarkerVae(tiny_pretrained().vae, tiny_vae_settings(), decode_scaled=scaled)
        for scaled in (False, True)
    )
    given = []
    for network in (plain, scaled):
        decoder = network.vae.post_quant_conv
        decoder.register_forward_pre_hook(lambda _, inputs: given.append(inputs[0].detach()))
        network(images)
    torch.testing.assert_close(given[0] * 0.18215, given[1])


def test_a_training_without_pairs_is_refused() -> None:
    pairs = striped_pairs()
    with pytest.raises(LearningError, match="pairs: found none"):
        train(pairs.of_pairs(torch.arange(0)), tiny_pretrained(), tiny_settings())
