from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.direct_translators import PLAIN, TINY, coarse, encoder, finished_run, tiny_network
from support.made_up_archives import made_up_archive
from support.training import session

from learning.config import preset_names, read_settings
from learning.data.splits import Split, make_split
from learning.errors import LearningError
from learning.training.run import LaunchSettings, RunFolder
from learning.translation.direct import KIND, DirectNetwork, load_network
from learning.translation.direct.data import AlignedImages, align
from learning.translation.direct.network import (
    PatchDiscriminator,
    discriminator_loss,
    generator_loss,
)
from learning.translation.direct.train import (
    PRESETS,
    Augmentation,
    DirectSettings,
    LossWeights,
    new_network,
    perceptual,
    reconstruction,
    train,
    validate,
)
from recorder import MarkerArchive
from tactile.__main__ import main

ALL_LOSSES = LossWeights(adversarial=0.1)
SMALL_SHIFT = Augmentation(mount_shift=1.0)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    path = tmp_path_factory.mktemp("archive") / "made-up.markers.zarr"
    return made_up_archive(path, indenters=("sphere",), unseen=(), frames_per_phase=1)


@pytest.fixture(scope="module")
def split(archive: MarkerArchive) -> Split:
    return make_split(archive, validation=0.3, new_press=0)


@pytest.fixture(scope="module")
def aligned(archive: MarkerArchive, split: Split) -> AlignedImages:
    return coarse(align(archive, split, "train"))


@pytest.mark.slow
def test_a_batch_that_is_learned_by_heart_is_translated_better_than_by_the_reference(
    aligned: AlignedImages,
) -> None:
    settings = replace(
        TINY, steps=45, batch=8, augmentation=PLAIN, average=0.9, validation_images=8
    )
    network = train(tiny_network(), aligned, None, settings)
    measured = validate(network, aligned, ((0, 1), (1, 0)), settings)
    assert measured["dice"] > measured["dice_of_reference"] + 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("losses", "moving"),
    [(LossWeights(), False), (ALL_LOSSES, True)],
    ids=["plain", "adversarial, moving"],
)
def test_every_weight_learns_but_those_of_the_reference_encoder(
    aligned: AlignedImages, losses: LossWeights, moving: bool, tmp_path: Path
) -> None:
    settings = replace(
        TINY,
        losses=losses,
        moving=moving,
        augmentation=replace(SMALL_SHIFT, no_source_reference=0.5),
    )
    start = tiny_network(settings)
    before = {name: value.clone() for name, value in start.state_dict().items()}
    with RunFolder.open(tmp_path / "run", KIND, settings, "data") as run:
        after = train(start, aligned, None, settings, session(settings, run)).state_dict()
        assert run.finished
        folder = run.latest()
    still = {name for name in before if torch.equal(before[name], after[name])}
    assert still == {name for name in before if name.startswith("reference_encoder.")}
    assert folder is not None
    assert (folder / "adversary.safetensors").exists() == bool(losses.adversarial)


def test_the_adversary_learns_to_tell_real_from_made_and_the_network_to_fool_it(
    aligned: AlignedImages,
) -> None:
    torch.manual_seed(0)
    adversary = PatchDiscriminator(8)
    before = {name: value.clone() for name, value in adversary.named_parameters()}
    optimiser = torch.optim.AdamW(adversary.parameters(), 1e-2)
    real = aligned.images[0][:4].unsqueeze(1).float() / 255
    reference = aligned.references[:1].expand(4, -1, -1).unsqueeze(1).float() / 255
    made = torch.rand_like(real)
    losses = []
    for _ in range(12):
        scores = adversary(torch.cat([real, made]), torch.cat([reference, reference]))
        loss = discriminator_loss(*scores.chunk(2))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0]
    moved = [not torch.equal(before[name], value) for name, value in adversary.named_parameters()]
    assert all(moved)
    with torch.no_grad():
        assert generator_loss(adversary(made, reference)) > generator_loss(
            adversary(real, reference)
        )


@pytest.mark.slow
def test_stopped_and_resumed_it_ends_in_the_same_weights(
    aligned: AlignedImages, tmp_path: Path
) -> None:
    settings = replace(TINY, losses=ALL_LOSSES)
    whole = train(tiny_network(), aligned, aligned, settings)
    with RunFolder.open(tmp_path / "run", KIND, settings, "data") as run:
        train(tiny_network(), aligned, aligned, settings, session(settings, run, 2))
        assert not run.finished
        assert run.latest() == tmp_path / "run/checkpoints/00000002"
    with RunFolder.open(tmp_path / "run", KIND, settings, "data", resume=True) as run:
        resumed = train(tiny_network(), aligned, aligned, settings, session(settings, run))
        assert run.finished
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_losses_without_weight_are_not_computed() -> None:
    logits, targets = torch.randn(2, 1, 32, 32), torch.rand(2, 1, 32, 32)
    only = LossWeights(cross_entropy=0, dice=2.0, perceptual=0)
    total, parts = reconstruction(logits, targets, encoder(), only)
    assert set(parts) == {"dice", "l2"}
    assert float(total) == pytest.approx(2 * float(parts["dice"]))
    with torch.no_grad():
        assert float(perceptual(encoder(), targets, targets)) == 0
        assert float(perceptual(encoder(), targets, 1 - targets)) > 0


@pytest.mark.slow
def test_fine_tuning_begins_with_the_weights_it_is_given_and_leaves_the_encoder(
    archive: MarkerArchive, split: Split, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    split.write(tmp_path / "split.json")
    finished_run(tmp_path / "pretrained")
    command = [
        "train",
        "direct",
        str(archive.path),
        f"--split={tmp_path / 'split.json'}",
        f"--from={tmp_path / 'pretrained'}",
        "--preset=cpu_smoke",
        *("--set=steps=1", "--set=warm_up=0", "--set=widths=[8, 8, 16]", "--set=batch=1"),
        *("--set=launch.device=cpu", "--set=validation_images=1", "--set=average=0.0"),
    ]
    rate = 1e-4
    out = tmp_path / "tuned"
    assert main([*command, f"--out={out}", f"--set=learning_rate={rate}"]) == 0
    before, after = (load_network(path)[0].state_dict() for path in (tmp_path / "pretrained", out))
    # The first step of AdamW has the length of the rate, and decays weights by a hundredth of it.
    for name, value in before.items():
        assert float((after[name] - value).abs().max()) <= 1.1 * rate, name
        if name.startswith("reference_encoder."):
            assert torch.equal(after[name], value), name
    assert any(not torch.equal(after[name], value) for name, value in before.items())

    for option, message in (
        ("--set=blocks=2", "blocks: found 2"),
        ("--sensors=dots", "two or more different"),
        ("--from=nowhere", "no config.yaml"),
    ):
        assert main([*command, f"--out={tmp_path / 'wrong'}", option]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "wrong").exists()


def test_a_translator_is_no_autoencoder(
    archive: MarkerArchive, split: Split, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    split.write(tmp_path / "split.json")
    finished_run(tmp_path / "pretrained")
    command = [
        "train",
        "direct",
        str(archive.path),
        f"--split={tmp_path / 'split.json'}",
        f"--autoencoder={tmp_path / 'pretrained'}",
        f"--out={tmp_path / 'out'}",
        "--preset=cpu_smoke",
    ]
    assert main(command) == 2
    assert "allowed: 'autoencoder'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_validation_on_other_sensors_is_refused(aligned: AlignedImages) -> None:
    other = replace(aligned, sensors=("dots", "diamonds"))
    with pytest.raises(LearningError, match="found sensors dots, diamonds"):
        train(tiny_network(), aligned, other, TINY)


def test_the_validation_measures_every_direction_alike(aligned: AlignedImages) -> None:
    settings = replace(TINY, validation_images=1000)
    network = new_network(settings, encoder())
    both = validate(network, aligned, ((0, 1), (1, 0)), settings)
    each = [validate(network, aligned, (pair,), settings) for pair in ((0, 1), (1, 0))]
    for name, value in both.items():
        assert np.isfinite(value)
        assert min(e[name] for e in each) - 0.05 <= value <= max(e[name] for e in each) + 0.05


@pytest.mark.parametrize("name", preset_names(PRESETS))
def test_presets_can_be_read(name: str) -> None:
    settings = read_settings(DirectSettings, PRESETS, name)
    assert settings.schedule.at(settings.warm_up) == pytest.approx(settings.learning_rate)


def test_the_network_of_the_preset_ours_has_nine_million_weights() -> None:
    settings = read_settings(DirectSettings, PRESETS, "ours")
    with torch.device("meta"):
        network = DirectNetwork(**settings.structure)
    weights = sum(each.numel() for each in network.parameters())
    assert 8.5e6 < weights < 11e6


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"heads": 3}, "heads: found 3"),
        ({"widths": (8, 8, 20)}, "widths: found"),
        ({"batch": 0}, "batch: found 0"),
        (
            {"losses": ALL_LOSSES, "launch": LaunchSettings(mixed_precision="fp16")},
            "found fp16 with an adversary",
        ),
    ],
)
def test_settings_that_cannot_be_are_refused(changed: dict[str, object], message: str) -> None:
    with pytest.raises(LearningError, match=message):
        replace(TINY, **changed)
