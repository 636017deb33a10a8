"""The contract of translators, which ours and one of another package keep."""

from pathlib import Path

import pytest
import torch
from support.commands import run_module
from support.foreign_model import installed
from support.made_up_archives import archive_of
from support.tiny_diffusion import DEEP_VAE, tiny_pretrained, tiny_settings, write_base
from support.tiny_field import tiny, untrained

from learning.cli import translate
from learning.errors import LearningError
from learning.training.checkpoint import Config
from learning.training.run import RunFolder
from learning.translation import SensorView, Translator, for_pair, load_translator
from learning.translation.diffusion.network import build
from learning.translation.diffusion.weights import BASE, fingerprint
from learning.translation.loading import hash_of
from recorder import MarkerArchive

archive = archive_of(indenters=("sphere",), unseen=(), targets=1, frames_per_phase=1)
foreign = installed()


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("models")
    run = RunFolder.open(folder / "field", "field", tiny(), "made up")
    run.finish(1, {"model": untrained()})
    base = str(write_base(folder / "sd-turbo", DEEP_VAE))
    pretrained, settings = tiny_pretrained(DEEP_VAE), tiny_settings(base=base)
    metadata = {BASE: fingerprint(base)}
    run = RunFolder.open(folder / "diffusion", "diffusion", settings, "x", metadata=metadata)
    run.finish(1, {"model": build(pretrained.unet, pretrained.vae, settings)})
    return folder


@pytest.fixture(scope="module", params=("flow", "field", "diffusion", "still"))
def translator(request: pytest.FixtureRequest, models: Path, foreign: None) -> Translator:
    name = request.param
    return load_translator(models / name if (models / name).is_dir() else name)


@pytest.mark.slow
def test_frames_become_masks_of_the_same_count_and_device(
    translator: Translator, archive: MarkerArchive
) -> None:
    source, target = archive["dots"], archive["grid"]
    pair = for_pair(translator, SensorView.of(source), SensorView.of(target))
    frames = torch.from_numpy(source.masks([0, 1, 2]))
    references = torch.from_numpy(target.reference(0)), torch.from_numpy(source.reference(0))
    made = pair.translate(frames, *references)
    assert (made.dtype, made.shape, made.device) == (torch.bool, (3, 480, 640), frames.device)
    assert translator.name
    again = pair.translate(frames, *references)
    assert torch.equal(made, again), "the same frames are translated alike"
    assert pair.translate(frames[:0], *references).shape == (0, 480, 640)
    assert torch.equal(frames, torch.from_numpy(source.masks([0, 1, 2]))), "inputs stay as they are"


def test_what_is_no_mask_is_refused(translator: Translator, archive: MarkerArchive) -> None:
    reference = torch.from_numpy(archive["grid"].reference(0))
    frames = torch.from_numpy(archive["dots"].masks([0]))
    for source, target, of_source, message in (
        (frames.byte(), reference, reference, "source: found uint8"),
        (frames[:, :10, :10], reference, reference, r"source: found bool \(1, 10, 10\)"),
        (frames, reference.float(), reference, "target_reference: found float32"),
        (frames, reference[:100], reference, "target_reference: found bool"),
        (frames, reference, frames, r"source_reference: found bool \(1, 480, 640\)"),
    ):
        with pytest.raises(LearningError, match=message):
            translator.translate(source, target, of_source)


def test_without_a_source_reference_a_press_in_order_begins_with_it(
    translator: Translator, archive: MarkerArchive
) -> None:
    press = torch.from_numpy(archive["dots"].masks([0, 2]))
    target = torch.from_numpy(archive["grid"].reference(0))
    due = translator.translate(press, target, press[0], ordered=True)
    assert torch.equal(translator.translate(press, target, ordered=True), due)
    if translator.name != "still":  # which needs none
        with pytest.raises(LearningError, match="source_reference: missing"):
            translator.translate(press, target)


def test_a_translator_of_another_package_is_opened_by_its_name_and_by_its_folder(
    archive: MarkerArchive, tmp_path: Path
) -> None:
    pair = ["--source", "dots", "--target", "grid"]
    out = tmp_path / "y.markers.zarr"
    assert run_module(translate, archive.path, *pair, "--model", "still", "--out", out) == 0
    made = MarkerArchive(out)["dots-to-grid"]
    assert (made.masks([0, 1]) == archive["grid"].reference(0)).all()
    assert made.attrs["model"] == "still"
    assert len(hash_of("still")) == 64
    Config("still", {}, "made up", "2.1").write(tmp_path)
    assert getattr(load_translator(tmp_path), "folder", None) == tmp_path


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("nothing", "returned int; allowed: a Translator"),
        ("missing", "cannot import foreign_still:absent"),
        ("unheard", "found kind 'unheard'; allowed: field.*still"),
    ],
)
def test_what_another_package_does_not_offer_is_refused(
    tmp_path: Path, kind: str, message: str
) -> None:
    Config(kind, {}, "made up", "2.1").write(tmp_path)
    with pytest.raises(LearningError, match=message):
        load_translator(tmp_path)
