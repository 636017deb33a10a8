from dataclasses import dataclass

import numpy as np
import pytest
import torch
from support.commands import run_module
from support.made_up_archives import archive_of, made_up_archive

from learning.cli import translate as command
from learning.data.splits import make_split
from learning.errors import LearningError
from learning.training.checkpoint import Config
from learning.translation import archive as translating
from learning.translation import load_translator
from learning.translation.archive import NamedTranslator, Pair, dice, translate_archive
from learning.translation.flow import FlowTranslator
from learning.translation.loading import hash_of
from learning.translation.translator import SensorView, for_pair
from recorder import MarkerArchive, SessionError
from recorder.archive import UNIT_ROWS, check_archive, location_pairs, write_simulated
from recorder.store.files import LOCAL

FLOW = NamedTranslator(FlowTranslator(), "flow", hash_of("flow"))


archive = archive_of(indenters=("sphere", "cone"), force_depth=1, invalid=(4,))


@pytest.fixture(scope="module")
def translated(archive: MarkerArchive, tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    out = tmp_path_factory.mktemp("translated") / "flow.markers.zarr"
    translate_archive(archive, out, [Pair("dots", "grid")], FLOW)
    return MarkerArchive(out)


@dataclass(frozen=True, slots=True)
class Same:
    """Translator that returns the frames unchanged and records its calls."""

    asked: list[tuple[int, bool]]
    name: str = "same"

    def translate(self, source, target_reference, source_reference=None, *, ordered=False):
        self.asked.append((len(source), ordered))
        return source.clone()


def test_frames_are_those_of_the_target_and_far_better_than_its_reference(archive, translated):
    made, target = translated["dots-to-grid"], archive["grid"]
    pairs = location_pairs(made.table, target.table)
    true = target.masks(pairs.target)
    still = target.reference(0)
    scores = [dice(*both) for both in zip(made.masks(pairs.source), true, strict=True)]
    base = [dice(still, one) for one in true]
    assert len(pairs) == 16
    assert np.mean(scores) > 0.97
    assert np.mean(scores) > np.mean(base) + 0.05
    assert min(scores) > 0.93


def test_labels_are_those_of_the_source_and_references_those_of_the_target(archive, translated):
    made, source, target = translated["dots-to-grid"], archive["dots"], archive["grid"]
    for name in ("indenter", "location", "target", "phase", "depth", "wrench", "frame", "valid"):
        np.testing.assert_array_equal(made.table[name], source.table[name])
    np.testing.assert_array_equal(made.references, target.references)
    assert made.mm_per_px == target.mm_per_px
    assert translated.indenters == archive.indenters
    assert (made.attrs["source"], made.attrs["target"]) == ("dots", "grid")
    assert (made.attrs["model"], made.attrs["model_sha256"]) == ("flow", FLOW.sha256)
    assert made.sources[made.table["source"][0]] == "made up"
    # A frame that is not there stays away.
    assert not made.table["valid"][4]
    assert not made.packed([4]).any()
    assert translated.warning is None
    assert {each.code for each in check_archive(LOCAL, translated.path)} <= {"marker-count"}


def test_presses_are_translated_whole_and_in_order(archive, tmp_path):
    asked: list[tuple[int, bool]] = []
    model = NamedTranslator(Same(asked), "same", "0")
    translate_archive(archive, tmp_path / "same.markers.zarr", [Pair("grid", "dots")], model)
    assert asked == [(8, True), *[(9, True)] * 4]
    made = MarkerArchive(tmp_path / "same.markers.zarr")["grid-to-dots"]
    np.testing.assert_array_equal(made.packed(slice(None)), archive["grid"].packed(slice(None)))


def test_a_stopped_run_goes_on_to_the_same_bytes(archive, tmp_path, monkeypatch):
    assert len(archive["grid"]) < UNIT_ROWS
    monkeypatch.setattr(translating, "UNIT_ROWS", 5)
    monkeypatch.setattr(translating, "CHUNK_ROWS", 5)
    pairs = [Pair("grid", "dots")]
    model = NamedTranslator(Same([]), "same", "0")
    whole, out = tmp_path / "whole.markers.zarr", tmp_path / "stopped.markers.zarr"
    translate_archive(archive, whole, pairs, model)

    def stop(done: int, total: int) -> None:
        if done >= 20:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        translate_archive(archive, out, pairs, model, progress=stop)
    assert MarkerArchive(out).warning is not None
    assert translate_archive(archive, out, pairs, model) == len(archive["grid"]) - 20
    files = sorted(each.relative_to(whole) for each in whole.rglob("*") if each.is_file())
    assert files == sorted(each.relative_to(out) for each in out.rglob("*") if each.is_file())
    assert all((whole / each).read_bytes() == (out / each).read_bytes() for each in files)


def test_another_model_does_not_go_on_with_an_archive(archive, translated):
    other = NamedTranslator(Same([]), "same", "1")
    before = translated["dots-to-grid"].packed([1])
    with pytest.raises(SessionError, match="is not the archive that was planned"):
        translate_archive(archive, translated.path, [Pair("dots", "grid")], other)
    np.testing.assert_array_equal(translated["dots-to-grid"].packed([1]), before)


@pytest.mark.slow
def test_forces_of_a_twin_follow_the_frames_of_a_part_of_the_source(tmp_path):
    archive = made_up_archive(tmp_path / "a.markers.zarr", force_depth=1)
    force = np.random.default_rng(0).normal(size=(len(archive["dots"]), 3))
    write_simulated(archive["dots"], force, 0.1 * force, "a twin")
    archive, out = MarkerArchive(archive.path), tmp_path / "t.markers.zarr"
    split = make_split(archive, validation=0.0, new_press=0.5, held_out_sensors=(), seed=0)
    pairs = [Pair("dots", "grid"), Pair("grid", "dots")]
    roles = ("new_indenter", "new_press")
    translate_archive(archive, out, pairs, FLOW, split=split, roles=roles)
    translated = MarkerArchive(out)
    assert list(check_archive(LOCAL, translated.path)) == []
    found, table = translated["dots-to-grid"].simulated, archive["dots"].table
    assert found is not None
    assert found.made_from == "a twin"
    keys = ("indenter", "target", "frame")
    rows = {key: row for row, key in enumerate(zip(*(table[name] for name in keys), strict=True))}
    made = translated["dots-to-grid"].table
    own = [rows[key] for key in zip(*(made[name] for name in keys), strict=True)]
    assert 0 < len(own) == len(split.rows(table, roles)) < len(force)
    assert set(split.role(made["location"])) == set(roles)
    np.testing.assert_array_equal(found.force, force[own])
    np.testing.assert_array_equal(found.spread, 0.1 * force[own])
    assert translated["grid-to-dots"].simulated is None


def test_a_press_without_contact_gives_the_target_reference_back(archive):
    source = torch.from_numpy(archive["dots"].reference(0))
    target = torch.from_numpy(archive["grid"].reference(0))
    made = FlowTranslator().translate(source[None], target, source)
    assert dice(made[0].numpy(), target.numpy()) > 0.999


def test_a_pair_of_other_scales_is_told_to_those_who_need_it():
    one, other = SensorView("a", 0.02, 0.02), SensorView("b", 0.04, 0.04)
    told = for_pair(FlowTranslator(), one, other)
    assert (told.source, told.target) == (one, other)
    same = Same([])
    assert for_pair(same, one, other) is same


def test_what_is_no_translator_is_refused(tmp_path):
    with pytest.raises(LearningError, match=r"found no config\.yaml"):
        load_translator(tmp_path)
    Config("force", {}, "data", "code").write(tmp_path)
    with pytest.raises(LearningError, match="found kind 'force'; allowed: field, diffu"):
        load_translator(tmp_path)
    Config("field", {}, "data", "code").write(tmp_path)
    with pytest.raises(LearningError):
        load_translator(tmp_path)


def test_weights_tell_models_apart(tmp_path):
    Config("field", {}, "data", "code").write(tmp_path)
    with pytest.raises(LearningError, match=r"found no model\.safetensors"):
        hash_of(tmp_path)
    (tmp_path / "model.safetensors").write_bytes(b"weights")
    assert hash_of(tmp_path) != hash_of("flow")
    assert load_translator("flow").name == "flow"


@pytest.mark.slow
def test_the_command_translates_and_draws(tmp_path, capsys):
    small = made_up_archive(tmp_path / "a.markers.zarr", ("dots", "grid"), ("sphere",), (), 1, 1)
    out, sheet = tmp_path / "x.markers.zarr", tmp_path / "x.png"
    words = [small.path, "--all", "--out", out]
    assert run_module(command, *words, "--sheet", sheet) == 0
    assert f"{out}: 2 pairs, 10 frames made" in capsys.readouterr().out
    assert list(MarkerArchive(out)) == ["dots-to-grid", "grid-to-dots"]
    assert sheet.read_bytes().startswith(b"\x89PNG")
    assert run_module(command, *words) == 0
    assert "0 frames made" in capsys.readouterr().out


def test_an_archive_that_is_half_written_is_refused(tmp_path):
    half = made_up_archive(tmp_path / "half.markers.zarr", indenters=("sphere",), finish=False)
    with pytest.raises(LearningError, match="still being written"):
        run_module(command, half.path, "--all", "--out", tmp_path / "x.markers.zarr")


def test_a_damaged_archive_is_an_error_and_the_rest_can_be_made_later(tmp_path):
    small = made_up_archive(tmp_path / "a.markers.zarr", ("dots", "grid"), ("sphere",), (), 1, 1)
    shard = small.path / "dots/markers/c.0.0"
    whole = shard.read_bytes()
    shard.write_bytes(whole[: len(whole) // 2])
    out, pair = tmp_path / "x.markers.zarr", [Pair("dots", "grid")]
    with pytest.raises(SessionError, match="dots"):
        translate_archive(MarkerArchive(small.path), out, pair, FLOW)
    shard.write_bytes(whole)
    assert translate_archive(MarkerArchive(small.path), out, pair, FLOW) == 5


def test_a_sensor_without_a_reference_is_refused(tmp_path):
    archive = made_up_archive(tmp_path / "a.markers.zarr", ("dots", "grid"), ("sphere",), (), 1, 1)
    archive["grid"].references[:] = 0
    with pytest.raises(LearningError, match="reference 0 of grid has no marker"):
        translate_archive(archive, tmp_path / "x.markers.zarr", [Pair("dots", "grid")], FLOW)
