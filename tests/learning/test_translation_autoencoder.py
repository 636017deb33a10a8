from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.made_up_archives import made_up_archive
from support.training import session

from learning.config import preset_names, read_settings
from learning.data.images import shrink, unit
from learning.data.splits import Split, make_split
from learning.errors import LearningError
from learning.training.run import LaunchSettings, RunFolder
from learning.translation.direct.autoencoder import (
    Autoencoder,
    divergence,
    orient,
    soft_dice,
)
from learning.translation.direct.train_autoencoder import (
    KIND,
    PRESETS,
    AutoencoderSettings,
    deformed_patterns,
    load_autoencoder,
    new_autoencoder,
    read_images,
    train,
    validate,
)
from recorder import MarkerArchive
from tactile.__main__ import main

TINY = AutoencoderSettings(
    description="of tests",
    widths=(8, 8, 16),
    latent=4,
    procedural=0.0,
    steps=4,
    batch=4,
    learning_rate=5e-3,
    warm_up=1,
    average=0.5,
    launch=LaunchSettings(device="cpu"),
    validate_every=2,
    validation_images=4,
    save_every=2,
)
NOTHING = torch.empty(0, 32, 32, dtype=torch.uint8)


@pytest.fixture(scope="module")
def images() -> torch.Tensor:
    """Return parts of random patterns, uint8 (8, 32, 32)."""
    drawn = deformed_patterns(8, np.random.default_rng(0), torch.device("cpu"))
    return (255 * drawn[:, 0, 112:144, 112:144]).round().to(torch.uint8)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    path = tmp_path_factory.mktemp("archive") / "made-up.markers.zarr"
    return made_up_archive(path, indenters=("sphere",), unseen=(), frames_per_phase=1)


@pytest.fixture(scope="module")
def split(archive: MarkerArchive) -> Split:
    return make_split(archive, validation=0.3, new_press=0, held_out_sensors=("grid",))


@pytest.mark.slow
def test_images_that_are_learned_by_heart_are_given_back(images: torch.Tensor) -> None:
    settings = replace(TINY, steps=40, batch=8, orientation=False, validate_every=40)
    before = validate(new_autoencoder(settings), images, 8)
    after = validate(train(images, images, settings), images, 8)
    assert after["l1"] < 0.6 * before["l1"]
    assert after["dice"] > 0.6


def test_every_weight_learns(images: torch.Tensor) -> None:
    before = new_autoencoder(TINY).state_dict()
    after = train(images, images, TINY).state_dict()
    still = [name for name in before if torch.equal(before[name], after[name])]
    assert still == []


@pytest.mark.slow
def test_stopped_and_resumed_it_ends_in_the_same_weights(
    images: torch.Tensor, tmp_path: Path
) -> None:
    settings = replace(TINY, procedural=0.5)
    whole = train(images, images, settings)
    with RunFolder.open(tmp_path / "run", KIND, settings, "data") as run:
        train(images, images, settings, session(settings, run, 2))
        assert not run.finished
        assert run.latest() == tmp_path / "run/checkpoints/00000002"
    with RunFolder.open(tmp_path / "run", KIND, settings, "data", resume=True) as run:
        resumed = train(images, images, settings, session(settings, run))
        assert run.finished
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_features_have_the_last_width_and_do_not_depend_on_the_company(
    images: torch.Tensor,
) -> None:
    network = new_autoencoder(TINY).eval()
    with torch.no_grad():
        batched = network.features(images)
        alone = network.features(images[3:4])
    assert batched.shape == (8, 16)
    assert torch.allclose(batched[3:4], alone, atol=1e-5)
    assert not torch.allclose(batched[0], batched[1], atol=1e-3)


def test_noise_of_the_latent_has_the_spread_that_was_learned() -> None:
    network = Autoencoder((8, 8, 16), 4)
    image = torch.rand(1, 1, 32, 32)
    noise = torch.zeros(1, 4, 4, 4)
    with torch.no_grad():
        exact, mean, log_variance = network(image)
        assert torch.equal(network(image, noise)[0], exact)
        assert not torch.equal(network(image, noise + 1)[0], exact)
    assert float(divergence(torch.zeros_like(mean), torch.zeros_like(log_variance))) == 0
    assert float(divergence(mean + 1, log_variance)) > 0


def test_turned_images_are_those_of_the_square_and_all_of_a_sample_alike() -> None:
    image = torch.rand(1, 1, 8, 8).expand(64, -1, -1, -1)
    one, other = orient([image, image + 1], np.random.default_rng(0))
    assert torch.equal(one + 1, other)
    kinds = {tuple(each.flatten().tolist()) for each in one}
    assert len(kinds) == 8


def test_dice_is_one_of_equal_images_and_nothing_of_disjoint_ones() -> None:
    left = torch.zeros(1, 1, 32, 32)
    left[..., :16] = 1
    assert float(soft_dice(left, left)) == pytest.approx(1)
    assert float(soft_dice(left, 1 - left)) < 0.01


def test_only_presses_to_train_on_are_read_and_no_sensor_that_is_held_out(
    archive: MarkerArchive, split: Split
) -> None:
    rows = split.rows(archive["dots"].table, "train")
    expected = torch.from_numpy(shrink(archive["dots"].packed(rows)))
    found = read_images([(archive, split)], "train", most=1000, seed=0)
    assert torch.equal(found, expected)
    fewer = read_images([(archive, split)], "train", most=4, seed=0)
    assert len(fewer) == 4


def test_the_command_trains_and_resumes_and_what_it_made_can_be_loaded(
    archive: MarkerArchive, split: Split, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    split.write(tmp_path / "split.json")
    out = tmp_path / "run"
    command = [
        "train",
        "autoencoder",
        str(archive.path),
        f"--split={tmp_path / 'split.json'}",
        f"--out={out}",
        "--preset=cpu_smoke",
        *("--set=steps=1", "--set=warm_up=0", "--set=widths=[8, 8, 16]", "--set=batch=2"),
        "--set=launch.device=cpu",
    ]
    assert main(command) == 0
    assert load_autoencoder(out).features(torch.zeros(2, 32, 32, dtype=torch.uint8)).shape == (
        2,
        16,
    )
    assert main(command) == 2
    assert "a run is there" in capsys.readouterr().err
    assert main([*command, "--resume"]) == 0
    assert "is finished" in capsys.readouterr().out


def test_no_images_and_no_patterns_are_nothing_to_learn_from() -> None:
    with pytest.raises(LearningError, match="procedural: found 0"):
        train(NOTHING, NOTHING, TINY)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LearningError, match=r"no config\.yaml"):
        load_autoencoder(tmp_path)
    with RunFolder.open(tmp_path / "run", "direct", TINY, "data") as run:
        run.finish(1, {"model": new_autoencoder(TINY)})
    with pytest.raises(LearningError, match="found kind 'direct'"):
        load_autoencoder(tmp_path / "run")


@pytest.mark.parametrize("name", preset_names(PRESETS))
def test_presets_can_be_read(name: str) -> None:
    settings = read_settings(AutoencoderSettings, PRESETS, name)
    assert settings.schedule.at(settings.warm_up) == pytest.approx(settings.learning_rate)


def test_losses_of_the_paper_are_a_preset() -> None:
    paper = read_settings(AutoencoderSettings, PRESETS, "paper")
    assert (paper.absolute, paper.squared, paper.divergence) == (1, 1, 1e-6)
    assert (paper.batch, paper.steps, paper.learning_rate) == (16, 100_000, 1e-4)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"widths": (8, 12, 16)}, "widths: found"),
        ({"latent": 0}, "latent: found 0"),
        ({"procedural": 1.5}, "procedural: found 1.5"),
    ],
)
def test_settings_that_cannot_be_are_refused(changed: dict[str, object], message: str) -> None:
    with pytest.raises(LearningError, match=message):
        replace(TINY, **changed)


def test_scaled_images_lie_between_nothing_and_one() -> None:
    image = unit(torch.tensor([[[0, 255]]], dtype=torch.uint8))
    assert image.tolist() == [[[[0.0, 1.0]]]]
