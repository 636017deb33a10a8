import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from support.commands import run_module
from support.made_up_archives import MM_PER_PX, archive_of, made_up_archive
from support.tiny_field import TINY, tiny, untrained
from support.training import session
from torch import Tensor

from learning.config import read_settings
from learning.data.splits import make_split
from learning.errors import LearningError
from learning.training.run import RunFolder
from learning.translation import load_translator
from learning.translation.field import command as train_field_verb
from learning.translation.field.data import FieldFrames, gather_role
from learning.translation.field.train import (
    PRESETS,
    FieldSettings,
    map_scores,
    net_scores,
    source_deformations,
    train_field,
)
from learning.translation.field.translator import FieldTranslator
from recorder import MarkerArchive

pytestmark = pytest.mark.slow

STAGES = ("field_stage", "map_stage")


def steps(field: int, map_: int, batch: int = 2) -> dict[str, object]:
    counts = dict(zip(STAGES, (field, map_), strict=True))
    return {f"{stage}.steps": count for stage, count in counts.items()} | {
        f"{stage}.{key}": value
        for stage in STAGES
        for key, value in (("batch", batch), ("warm_up_steps", 1))
    }


SETTINGS = tiny(**steps(5, 5), validate_every_steps=4)


archive = archive_of(indenters=("sphere",), unseen=(), targets=3, frames_per_phase=1)


@pytest.fixture(scope="module")
def frames(archive: MarkerArchive) -> FieldFrames:
    found = gather_role(archive, make_split(archive), tuple(archive), "train")
    assert found is not None
    return found


@pytest.fixture(scope="module")
def trained(frames: FieldFrames) -> dict[str, Tensor]:
    """Return the weights after an uninterrupted training with `SETTINGS`."""
    return train_field(frames, SETTINGS).state_dict()


def test_every_parameter_learns(trained: dict[str, Tensor]) -> None:
    before = untrained(SETTINGS).state_dict()
    # Weight decay moves nonzero weights: trained weights move by more than that.
    decay = 5 * SETTINGS.field_stage.learning_rate * SETTINGS.weight_decay
    lazy = [
        name
        for name, value in trained.items()
        if float((value - before[name]).abs().max()) <= decay * float(before[name].abs().max())
    ]
    assert not lazy
    assert trained["usual_scale"].tolist() == pytest.approx([MM_PER_PX, MM_PER_PX])


def test_the_field_net_stays_as_it_is_while_the_map_learns(frames: FieldFrames) -> None:
    settings = tiny(**steps(0, 2))
    before = untrained(settings).net.state_dict()
    after = train_field(frames, settings).net.state_dict()
    assert all(torch.equal(value, before[name]) for name, value in after.items())


@pytest.mark.parametrize("stopped_after", [3, 5, 7])
def test_a_training_that_was_stopped_ends_as_one_that_was_not(
    frames: FieldFrames, trained: dict[str, Tensor], tmp_path: Path, stopped_after: int
) -> None:
    run = RunFolder.open(tmp_path / "run", "field", SETTINGS, "data")
    train_field(frames, SETTINGS, session=session(SETTINGS, run, stopped_after))
    assert not run.finished
    assert run.latest() == tmp_path / f"run/checkpoints/{stopped_after:08d}"
    run = RunFolder.open(tmp_path / "run", "field", SETTINGS, "data")
    train_field(frames, SETTINGS, frames, session(SETTINGS, run))
    assert run.finished
    resumed = load_translator(tmp_path / "run")
    assert isinstance(resumed, FieldTranslator)
    for name, value in resumed.model.state_dict().items():
        assert torch.equal(value, trained[name]), name
    log = (tmp_path / "run/metrics.jsonl").read_text().splitlines()
    assert any("map/validation_dice" in json.loads(line) for line in log)


def test_training_without_pairs_for_the_map_is_refused(frames: FieldFrames) -> None:
    with pytest.raises(LearningError, match="pairs: found none"):
        train_field(replace(frames, pairs=frames.pairs[:0]), tiny(**steps(1, 1)))


def test_a_loss_that_is_lost_ends_the_training_and_saves_nothing(
    frames: FieldFrames, tmp_path: Path
) -> None:
    settings = tiny(**steps(30, 0), **{"field_stage.learning_rate": 1e30})
    run = RunFolder.open(tmp_path / "run", "field", settings, "data")
    with pytest.raises(LearningError, match="found a loss of"):
        train_field(frames, settings, session=session(settings, run))
    assert run.latest() is None


def test_weights_of_another_network_are_refused(frames: FieldFrames, tmp_path: Path) -> None:
    settings = tiny(**steps(1, 0))
    run = RunFolder.open(tmp_path / "a", "field", settings, "data")
    train_field(frames, settings, session=session(settings, run))
    config = (tmp_path / "a/config.yaml").read_text()
    (tmp_path / "a/config.yaml").write_text(config.replace("numbers: 4", "numbers: 5"))
    with pytest.raises(LearningError, match="map"):
        load_translator(tmp_path / "a")


def test_the_command_trains_a_model_that_translates(archive: MarkerArchive, tmp_path: Path) -> None:
    make_split(archive).write(tmp_path / "split.json")
    sets = [f"--set={key}={value}" for key, value in (TINY | steps(1, 1)).items()]
    command = [str(archive.path), "--split", str(tmp_path / "split.json")]
    command += ["--out", str(tmp_path / "run"), "--preset", "cpu_smoke", *sets]
    assert run_module(train_field_verb, *command) == 0
    sensor = archive["dots"]
    made = load_translator(tmp_path / "run").translate(
        torch.from_numpy(sensor.masks([0, 2])),
        torch.from_numpy(archive["grid"].reference(0)),
        torch.from_numpy(sensor.reference(0)),
    )
    assert made.shape == (2, 480, 640)
    assert run_module(train_field_verb, *command) == 0, "it is finished"
    with pytest.raises(LearningError, match="was begun with other"):
        run_module(train_field_verb, *command, "--set=seed=1")


@pytest.mark.timeout(600)
def test_one_batch_is_learned_by_heart(frames: FieldFrames) -> None:
    four = {name: getattr(frames, name)[:4] for name in ("images", "sensor", "reference")}
    few = replace(frames, **four, pairs=frames.pairs[:0], shift=None)
    changes = {"examples.procedural": 0, "examples.move": 0, "field_stage.learning_rate": 2e-3}
    model = train_field(few, tiny(**steps(120, 0, batch=4), **changes))
    scores = net_scores(model, few, 4, 0)
    # The true field reaches 0.985 on one sensor and 0.965 on the other.
    assert scores["dice"] > 0.95
    assert scores["dice_still"] < 0.9


@pytest.mark.timeout(600)
def test_patterns_and_indenters_never_seen_are_better_than_without_a_warp(tmp_path: Path) -> None:
    sensors = ("dots", "grid", "diamonds", "dense")
    archive = made_up_archive(tmp_path / "x.markers.zarr", sensors, targets=8)
    held_out = ("diamonds", "dense")
    split = make_split(archive, held_out_sensors=held_out)
    training = gather_role(archive, split, ("dots", "grid"), "train")
    unseen = gather_role(archive, split, held_out, "new_indenter")
    assert training is not None
    assert unseen is not None
    short = ["field_stage.steps=150", "map_stage.steps=40"]
    model = train_field(training, read_settings(FieldSettings, PRESETS, "cpu_smoke", short))
    scores = net_scores(model, unseen, 32, 0)
    assert scores["dice"] > scores["dice_still"] + 0.03
    assert scores["shift_error_px"] < 2.0
    mapped = map_scores(model, unseen, source_deformations(model, unseen), 32, 0)
    assert mapped["dice"] > mapped["dice_still"] + 0.03
