"""The trained diffusion translator from archive to masks, and loading from its folder."""

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from support.commands import run_module
from support.made_up_archives import archive_of
from support.tiny_diffusion import (
    DEEP_VAE,
    VAE_STAGE,
    tiny_pretrained,
    tiny_settings,
    tiny_vae_settings,
    write_base,
    write_judges,
)

from learning.data.images import shrink, unit
from learning.data.pairs import paired_rows, read_paired
from learning.data.splits import make_split, read_split
from learning.errors import LearningError
from learning.evaluation.distribution import load_extractor
from learning.training.checkpoint import read_model_folder
from learning.training.run import METRICS, RunFolder
from learning.translation import Translator, load_translator
from learning.translation.diffusion import command
from learning.translation.diffusion.network import (
    KIND,
    MarkerToMarker,
    MarkerVae,
    build,
    load_vae,
    rank_of,
    vae_adapter_of,
)
from learning.translation.diffusion.network import MARKER_VAE as VAE
from learning.translation.diffusion.train import IMAGES_PER_S, MEMORY_GIB
from learning.translation.diffusion.translator import DiffusionTranslator
from learning.translation.diffusion.weights import BASE, base_of, fingerprint
from recorder import MarkerArchive


def _network(*, moved: bool) -> MarkerToMarker:
    made = tiny_pretrained(DEEP_VAE)
    network = build(made.unet, made.vae, tiny_settings())
    if moved:
        chance = torch.Generator().manual_seed(2)
        for each in network.state_dict().values():
            each.add_(torch.randn(each.shape, generator=chance) * 0.3)
    return network


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished training, next to the published weights."""
    folder = tmp_path_factory.mktemp("finished")
    base = write_base(folder / "sd-turbo", DEEP_VAE)
    settings = tiny_settings(base=str(base))
    metadata = {BASE: fingerprint(str(base))}
    run = RunFolder.open(folder / "run", KIND, settings, "made up", metadata=metadata)
    run.finish(4, {"model": _network(moved=True)})
    return folder / "run"


archive = archive_of(
    indenters=("sphere", "cone"), targets=3, frames_per_phase=1, displacement=False
)


def _masks(archive: MarkerArchive) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    dots, grid = archive["dots"], archive["grid"]
    references = torch.from_numpy(grid.reference(0)), torch.from_numpy(dots.reference(0))
    return torch.from_numpy(dots.masks([0, 1])), *references


@pytest.mark.slow
def test_a_loaded_translator_gives_what_the_trained_network_gives(
    finished: Path, archive: MarkerArchive
) -> None:
    loaded: Translator = load_translator(finished)
    trained = DiffusionTranslator(_network(moved=True), "trained", batch=2)
    masks, target, source = _masks(archive)
    found = loaded.translate(masks, target, source)
    assert found.shape == (2, 480, 640)
    assert found.dtype == torch.bool
    # One of them has fused adapters: grey levels next to the threshold may round differently.
    assert float((found != trained.translate(masks, target, source)).float().mean()) < 1e-3
    assert 0 < int(found.sum()) < found.numel()
    assert loaded.name.startswith("diffusion ")


def test_published_weights_are_found_beside_a_model_and_others_are_refused(
    finished: Path, tmp_path: Path
) -> None:
    moved, base = tmp_path / "run", finished.parent / "sd-turbo"
    shutil.copytree(finished, moved)
    assert base_of(read_model_folder(moved, KIND)) == str(base)
    (moved / "base").symlink_to(base)
    config = moved / "config.yaml"
    config.write_text(config.read_text().replace(str(base), "another"))
    found = read_model_folder(moved, KIND)
    assert base_of(found) == str(moved / "base")
    (moved / "base").unlink()
    with pytest.raises(LearningError, match="link the folder of SD-Turbo"):
        base_of(found)
    shutil.copytree(base, moved / "base")
    path = moved / "base" / "unet" / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "sample_size": 5}))
    with pytest.raises(LearningError, match="was trained from published weights"):
        load_translator(moved)


def test_pairs_of_many_sensors_keep_every_image_once(archive: MarkerArchive) -> None:
    split = make_split(archive, validation=0.34, new_press=0)
    rows = paired_rows(archive, split, ["dots", "grid"], "train")
    frames = read_paired(archive, rows)
    # Two presses of the sphere with four phases each; two sensors, in both directions.
    assert (len(frames.pairs), len(frames), len(frames.references)) == (16, 16, 2)
    ends = [tuple(pair) for pair in frames.pairs.tolist()]
    assert sorted(ends) == sorted((target, source) for source, target in ends)
    for name, begin in (("dots", 0), ("grid", 8)):
        shown = shrink(archive[name].packed(rows[name]))
        assert torch.equal(frames.images[begin : begin + 8], torch.from_numpy(shown))
    every = paired_rows(archive, split, ["dots"], "train", every=1)["dots"]
    assert len(every) == len(split.rows(archive["dots"].table, "train")) == 10
    with pytest.raises(LearningError, match="no sensor 'dense'; known: dots, grid"):
        paired_rows(archive, split, ["dots", "dense"], "train")


@pytest.mark.slow
def test_verbs_train_both_stages_and_resume(
    archive: MarkerArchive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    split = make_split(archive, validation=0.34, new_press=0)
    split.write(tmp_path / "split.json")
    assert read_split(tmp_path / "split.json") == split
    base = write_base(tmp_path / "sd-turbo", DEEP_VAE)
    shared = ["--split", str(tmp_path / "split.json"), "--base", str(base)]
    none = ["losses.adversarial=0", "losses.perceptual=0"]
    tiny = ["steps=2", "batch=1", "launch={device: cpu, mixed_precision: no}",
            f"marker_vae={VAE_STAGE}"]  # fmt: skip
    begin = [str(archive.path), *shared, *(f"--set={each}" for each in (*tiny, *none))]
    run = partial(run_module, command)
    out = tmp_path / "m2m"
    assert run(*begin, "--out", str(out)) == 0
    vae = load_vae(out / "marker-vae")
    assert read_model_folder(out / "marker-vae").config.step == 4
    state = read_model_folder(out).weights()
    # The reference encoder is the marker VAE's, and stays as it is.
    adapter = vae_adapter_of(vae.state_dict())
    name = next(name for name in adapter if name.startswith("encoder."))
    assert torch.equal(state[f"reference.{name}"], adapter[name])
    assert run(*begin, "--out", str(out)) == 0
    assert "is finished" in capsys.readouterr().out
    given = ["--marker-vae", str(out / "marker-vae"), "--out", str(tmp_path / "given")]
    assert run(*begin, *given) == 0
    assert not (tmp_path / "given" / "marker-vae").exists()
    again = read_model_folder(tmp_path / "given").weights()
    assert all(torch.equal(again[name], each) for name, each in state.items())
    assert run(*begin, "--from", str(out), "--out", str(tmp_path / "fine")) == 0
    masks, target, source = _masks(archive)
    assert load_translator(tmp_path / "fine").translate(masks, target, source).shape == masks.shape
    with pytest.raises(LearningError, match="was begun with other"):
        run(*begin, "--set=seed=7", "--out", str(out))
    with pytest.raises(LearningError, match="found both"):
        run(*begin, *given[:2], "--from", str(out), "--out", str(tmp_path / "x"))


@pytest.mark.slow  # half a minute: 20 steps at 256 x 256, with all networks
def test_the_published_losses_train_the_adapters_from_a_users_weights(
    archive: MarkerArchive, tmp_path: Path
) -> None:
    base, out = write_base(tmp_path / "sd-turbo", DEEP_VAE), tmp_path / "m2m"
    given = {"base": base, **write_judges(tmp_path), "out": out, "preset": "paper_main"}
    options = [word for name, path in given.items() for word in (f"--{name}", str(path))]
    few = ["steps=20", "batch=2", "log_every=1", "launch.device=cpu", "marker_vae.steps=0",
           "optimiser.rate={kind: constant, rate: 0.02}", "sample_latents=false"]  # fmt: skip
    assert run_module(command, archive.path, *options, *(f"--set={each}" for each in few)) == 0
    logged = map(json.loads, (out / METRICS).read_text().splitlines())
    lines = [line for line in logged if "train/square" in line]
    assert len(lines) == 20
    parts = ("square", "perceptual", "adversarial", "discriminator")
    for name in (*(f"train/{part}" for part in parts), IMAGES_PER_S, MEMORY_GIB):
        assert all(line[name] > 0 for line in lines), name
    apart = [5.0 * line["train/perceptual"] + line["train/square"] for line in lines]
    assert np.mean(apart[-5:]) < 0.98 * np.mean(apart[:5])
    state = read_model_folder(out).weights()
    for part, rank in (("unet.", 8), ("vae.", 4)):
        own = {name: each for name, each in state.items() if name.startswith(part)}
        assert rank_of(own) == rank
        assert all(bool(each.any()) for name, each in own.items() if ".lora_B." in name)


@pytest.mark.slow
def test_features_of_images_are_the_latents_of_the_marker_vae(tmp_path: Path) -> None:
    base = str(write_base(tmp_path / "base", DEEP_VAE))
    settings = tiny_vae_settings(f"weights.base={base}")
    network = MarkerVae(tiny_pretrained(DEEP_VAE).vae, settings)
    metadata = {BASE: fingerprint(base)}
    run = RunFolder.open(tmp_path / "vae", VAE, settings, "made up", metadata=metadata)
    run.finish(1, {"model": network})
    images = torch.randint(0, 2, (70, 256, 256), dtype=torch.uint8) * 255
    extractor = load_extractor(str(tmp_path / "vae"))
    features = extractor.features(images.numpy())
    assert extractor.name.startswith("marker-vae@sha256:")
    assert features.shape == (70, 4 * 64)
    with torch.no_grad():
        latent = network.latent(unit(images[69:]))
    cells = torch.nn.functional.avg_pool2d(latent, latent.shape[-1] // 8).flatten()
    np.testing.assert_allclose(features[69], cells.double().numpy(), rtol=1e-4, atol=1e-6)
    with pytest.raises(LearningError, match="--features: found 'nothing'"):
        load_extractor("nothing")
