"""The trained diffusion translator from archive to masks, and loading from its folder."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import pytest
import torch
from support.commands import run_module
from support.made_up_archives import made_up_archive
from support.tiny_diffusion import DEEP_VAE, tiny_pretrained, tiny_settings, write_base

from learning.data.splits import make_split, read_split
from learning.errors import LearningError
from learning.training.checkpoint import read_model_folder
from learning.training.run import RunFolder
from learning.translation import Translator, load_translator
from learning.translation.diffusion import command, vae_command
from learning.translation.diffusion.data import read_image_pairs, read_role_images
from learning.translation.diffusion.network import MarkerToMarker, build
from learning.translation.diffusion.train import BASE, KIND
from learning.translation.diffusion.translator import DiffusionTranslator, base_of
from learning.translation.diffusion.weights import fingerprint
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
    with RunFolder.open(folder / "run", KIND, settings, "made up", metadata=metadata) as run:
        run.finish(4, {"model": _network(moved=True)})
    return folder / "run"


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    return made_up_archive(
        tmp_path_factory.mktemp("archive") / "x.markers.zarr",
        indenters=("sphere", "cone"),
        targets=3,
        frames_per_phase=1,
        displacement=False,
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
    # In ordered mode the first frame is the source's reference.
    by_order = loaded.translate(masks[:1], target, ordered=True)
    assert torch.equal(masks[0], source)
    assert float((found[:1] != by_order).float().mean()) < 1e-3
    with pytest.raises(LearningError, match="source_reference: missing"):
        loaded.translate(masks, target)
    with pytest.raises(LearningError, match="target_reference: found bool"):
        loaded.translate(masks, target[:100], source)
    assert loaded.translate(masks[:0], target, source).shape == (0, 480, 640)


def test_published_weights_are_found_beside_a_model_and_others_are_refused(
    finished: Path, tmp_path: Path
) -> None:
    moved, base = tmp_path / "run", finished.parent / "sd-turbo"
    shutil.copytree(finished, moved)
    found = read_model_folder(moved, KIND)
    assert base_of(found, str(base)) == str(base)
    (moved / "base").symlink_to(base)
    assert base_of(found, "where it was once") == str(moved / "base")
    (moved / "base").unlink()
    with pytest.raises(LearningError, match="link the folder of SD-Turbo"):
        base_of(found, "where it was once")
    shutil.copytree(base, moved / "base")
    path = moved / "base" / "unet" / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "sample_size": 5}))
    with pytest.raises(LearningError, match="was trained from published weights"):
        load_translator(moved)


def test_pairs_of_many_sensors_keep_every_image_once(archive: MarkerArchive) -> None:
    split = make_split(archive, validation=0.34, new_press=0)
    pairs = read_image_pairs(archive, split, "train")
    # Two presses of the sphere with four phases each; two sensors, in both directions.
    assert (len(pairs), len(pairs.images), len(pairs.references)) == (16, 16, 2)
    rows = split.rows(archive["dots"].table, "train")
    assert len(read_role_images(archive, split, "train", sensors=["dots"])) == len(rows) == 10
    source, target = pairs.source.tolist(), pairs.target.tolist()
    assert sorted(zip(source, target, strict=True)) == sorted(zip(target, source, strict=True))
    one_way = read_image_pairs(archive, split, "train", pairs=[("grid", "dots")])
    assert torch.equal(one_way.images[one_way.source], pairs.images[pairs.source[8:]])
    assert torch.equal(one_way.images[one_way.target], pairs.images[pairs.target[8:]])
    with pytest.raises(LearningError, match="no sensor dense; known: dots, grid"):
        read_image_pairs(archive, split, "train", sensors=["dots", "dense"])


@pytest.mark.slow
def test_verbs_train_both_stages_and_resume(
    archive: MarkerArchive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    split = make_split(archive, validation=0.34, new_press=0)
    split.write(tmp_path / "split.json")
    assert read_split(tmp_path / "split.json") == split
    base = write_base(tmp_path / "sd-turbo", DEEP_VAE)
    shared = ["--split", str(tmp_path / "split.json"), "--base", str(base)]
    tiny = ["--set", "steps=2", "--set", "batch=1", "--set", "launch.device=cpu",
            "--set", "optimiser.rate={kind: constant, rate: 0.001}"]  # fmt: skip
    run = partial(run_module, vae_command)
    vae = tmp_path / "vae"
    assert run(*[str(archive.path), *shared, *tiny, "--out", str(vae)]) == 0
    assert run(*[str(archive.path), *shared, *tiny, "--out", str(vae), "--resume"]) == 0
    assert "is finished" in capsys.readouterr().out
    run = partial(run_module, command)
    none = ["--set", "losses.adversarial=0", "--set", "losses.perceptual=0"]
    begin = [str(archive.path), *shared, *tiny, *none]
    out = tmp_path / "m2m"
    assert run(*[*begin, "--marker-vae", str(vae), "--out", str(out)]) == 0
    assert run(*[*begin, "--from", str(out), "--out", str(tmp_path / "fine")]) == 0
    masks, target, source = _masks(archive)
    assert load_translator(tmp_path / "fine").translate(masks, target, source).shape == masks.shape
    with pytest.raises(LearningError, match="a run is there"):
        run(*[*begin, "--marker-vae", str(vae), "--out", str(out)])
    with pytest.raises(LearningError, match="found both"):
        run(*[*begin, "--marker-vae", str(vae), "--from", str(out), "--out", str(tmp_path / "x")])
    with pytest.raises(LearningError, match="clip: found ''"):
        run(*[str(archive.path), *shared, *tiny, "--out", str(tmp_path / "judged")])
