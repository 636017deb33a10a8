import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.force_models import TOY, noise_presses, toy
from support.training import session

from learning.data.presses import AUTHORS, Presses, load_presses
from learning.data.splits import make_split
from learning.errors import LearningError
from learning.force import load_force_model
from learning.force.batched import train_batched
from learning.force.labels import Relabelling
from learning.force.model import KIND, ForceModel, InputSettings
from learning.force.train import (
    ForceModelSettings,
    ForceStageSettings,
    OptimiserSettings,
    Sequences,
    SequenceSettings,
    epoch,
    error,
    force_range,
    forces_of,
    frames_of,
    initial_model,
    superposed,
    train_force,
)
from learning.metrics import r_squared
from learning.training.run import METRICS, RunFolder
from recorder import MarkerArchive
from tactile.__main__ import main
from tests.support.few import few

# All state that a run has to restore.
EVERYTHING = toy(
    stages=(
        ForceStageSettings(epochs=3, learning_rate=3e-3, schedule="authors", one_sensor=True),
        ForceStageSettings(epochs=3, learning_rate=1e-2, schedule="cosine", warm_up_steps=2),
    ),
    network=replace(TOY.network, encoder_norm="batch", tail_norm="batch", dropout=0.1),
    sequences=SequenceSettings(batch=2, flips=True, presses=2),
    patience_epochs=2,
)
SEVERAL = [noise_presses(4, seed=1), noise_presses(5, seed=2)]
HELD = noise_presses(2, seed=3)


def _open(path: Path, settings: ForceModelSettings = TOY) -> RunFolder:
    return RunFolder.open(path, KIND, settings, "data")


@pytest.mark.slow
@pytest.mark.parametrize("inputs", [TOY.input, InputSettings(form="field")], ids=["both", "field"])
def test_it_overfits_a_batch(inputs: InputSettings) -> None:
    presses = noise_presses(2, form=inputs.stored_form)
    stage = ForceStageSettings(epochs=60, learning_rate=1e-2, schedule="cosine")
    off = train_force(presses, toy(input=inputs, stages=(stage,))).predict(presses)
    wanted = presses.wrench.numpy()
    assert np.abs(off - wanted).mean() < 0.25 * np.abs(wanted - wanted.mean(axis=0)).mean()


@pytest.fixture(scope="module")
def not_stopped(tmp_path_factory: pytest.TempPathFactory) -> tuple[ForceModel, str]:
    """Return the model of a run of `EVERYTHING`, and its log."""
    path = tmp_path_factory.mktemp("whole") / "run"
    run = _open(path, EVERYTHING)
    model = train_force(SEVERAL, EVERYTHING, session(EVERYTHING, run), validation=HELD)
    return model, (path / "metrics.jsonl").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("steps", few([3, 7], 1))
def test_a_run_that_was_stopped_ends_as_one_that_was_not(
    tmp_path: Path, steps: int, not_stopped: tuple[ForceModel, str]
) -> None:
    whole, log = not_stopped
    run = _open(tmp_path / "parts", EVERYTHING)
    stopping = session(EVERYTHING, run, steps + 1)
    train_force(SEVERAL, EVERYTHING, stopping, validation=HELD)
    assert not run.finished
    run = _open(tmp_path / "parts", EVERYTHING)
    parts = train_force(SEVERAL, EVERYTHING, session(EVERYTHING, run), validation=HELD)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, parts.state_dict()[name]), name
    assert (tmp_path / "parts" / "metrics.jsonl").read_text() == log


def test_what_a_model_is_made_of_must_fit(tmp_path: Path) -> None:
    train_force(noise_presses(3), TOY, session(TOY, _open(tmp_path / "run")))
    config = (tmp_path / "run" / "config.yaml").read_text()
    (tmp_path / "run" / "config.yaml").write_text(config.replace("memory: 8", "memory: 12"))
    with pytest.raises(LearningError, match="memory"):
        load_force_model(tmp_path / "run")
    (tmp_path / "run" / "config.yaml").write_text(config.replace("kind: force", "kind: direct"))
    with pytest.raises(LearningError, match="found kind 'direct'"):
        load_force_model(tmp_path / "run")
    with pytest.raises(LearningError, match="nowhere"):
        load_force_model(tmp_path / "nowhere")


def test_validation_keeps_the_best_weights_and_ends_a_stage() -> None:
    presses, held = noise_presses(3, seed=1), noise_presses(2, seed=2)
    patient = toy(stages=(ForceStageSettings(epochs=15, learning_rate=0.1),), patience_epochs=2)
    steps: list[int] = []
    watched = replace(session(patient), progress=lambda done, total: steps.append(done))
    predictor = train_force(presses, patient, watched, validation=held)
    assert len(steps) < 15 * 2
    best = np.abs(predictor.predict(held) - held.wrench.numpy()).mean()
    endless = train_force(presses, replace(patient, patience_epochs=None))
    assert best <= np.abs(endless.predict(held) - held.wrench.numpy()).mean()


def test_only_the_last_stage_ends_early(tmp_path: Path) -> None:
    # A rate so small that no weight changes: no validation is better than the first.
    still = ForceStageSettings(epochs=4, learning_rate=1e-30)
    optimiser = OptimiserSettings(name="sgd", weight_decay=0.0)
    settings = toy(stages=(still, still), patience_epochs=1, optimiser=optimiser)
    run = _open(tmp_path / "run", settings)
    train_force(noise_presses(2), settings, session(settings, run), validation=HELD)
    lines = (run.path / METRICS).read_text().splitlines()
    assert [json.loads(line)["stage"] for line in lines] == [0, 0, 0, 0, 1, 1]


@pytest.mark.slow  # minutes: its rate of 0.1 leaves its start after some 400 steps
@pytest.mark.timeout(1800)
def test_the_papers_training_learns_at_a_quarter_of_the_width(tmp_path: Path) -> None:
    shown, out = str(tmp_path / "demo.markers.zarr"), tmp_path / "net"
    small = ["--tier", "layer", "--scale", "0.025", "--steps", "1", "--no-check"]
    assert (
        main(["sim", "archive", "examples/demo-learning/circle.yaml", *small, "--out", shown]) == 0
    )
    stages = "{epochs: 100, learning_rate: 0.1}, {epochs: 25, learning_rate: 0.001}"
    few = ["--preset", "examples/demo-paper/quarter.yaml", "--set", f"stages=[{stages}]"]
    assert main(["train", "force", shown, *few, "--out", str(out)]) == 0
    lines = [json.loads(line) for line in (out / METRICS).read_text().splitlines()]
    losses = [line["loss"] for line in lines if line["stage"] == 0]
    assert len(losses) == 100  # no early end, though no validation is better for long
    assert losses[-1] < 0.4 * losses[0]
    (one,) = (archive := MarkerArchive(shown)).values()
    presses = load_presses(one, make_split(archive).rows(one.table, "new_indenter"))
    assert r_squared(presses.wrench.numpy(), load_force_model(out).predict(presses)).min() > 0.6


def test_starting_from_a_model_begins_with_its_weights() -> None:
    presses = noise_presses(3)
    first = train_force(presses, TOY)
    still = toy(stages=(ForceStageSettings(epochs=1, learning_rate=1e-12),))
    second = train_force(presses, still, start_from=first)
    assert np.allclose(first.predict(presses), second.predict(presses), atol=1e-4)
    wider = replace(TOY, network=replace(TOY.network, memory=12))
    with pytest.raises(LearningError, match="start_from: not the weights of this network"):
        train_force(presses, wider, start_from=first)
    normed = replace(TOY, network=replace(TOY.network, encoder_norm="instance"))
    with pytest.raises(LearningError, match=r"found network\.encoder_norm none; allowed: instance"):
        train_force(presses, normed, start_from=first)


def test_compensation_changes_labels_before_their_range_is_taken() -> None:
    presses = noise_presses(3)

    def doubled(rows: Any, wrench: Any, depth: Any, phase: Any) -> Any:
        assert rows.shape == depth.shape == phase.shape == (len(wrench),)
        return wrench * np.where(depth > 0, 2.0, 1.0)[:, None]

    plain = train_force(presses, TOY)
    changed = train_force(Relabelling(doubled).of(presses), TOY)
    assert torch.allclose(changed.low, 2 * plain.low)


def test_presses_that_cannot_be_learned_from_are_refused_and_nothing_is_written(
    tmp_path: Path,
) -> None:
    presses = noise_presses(3)
    missing = replace(presses, wrench=presses.wrench * torch.nan)
    run = _open(tmp_path / "run")
    with pytest.raises(LearningError, match="found no label of Fx, Fy or Fz in"):
        train_force(missing, TOY, session(TOY, run))
    with pytest.raises(LearningError, match="found field; allowed: images"):
        train_force(noise_presses(form="field"), TOY, session(TOY, run))
    with pytest.raises(LearningError, match="found none of a sensor"):
        train_force([], TOY, session(TOY, run))
    assert run.latest() is None
    assert not run.finished


def test_a_loss_that_is_no_number_ends_training_and_leaves_the_last_checkpoint(
    tmp_path: Path,
) -> None:
    wild = toy(stages=(ForceStageSettings(epochs=4, learning_rate=1e38),))
    wild = replace(wild, optimiser=replace(wild.optimiser, name="sgd", clip=None))
    run = _open(tmp_path / "run", wild)
    with pytest.raises(LearningError, match="loss: found nan"):
        train_force(noise_presses(4), wild, session(wild, run))
    assert not run.finished


def test_the_box_of_forces_is_that_of_the_labels_or_of_the_authors() -> None:
    labels = [torch.tensor([[1.0, -2.0, -6.0], [0.0, 1.0, 0.0]])]
    assert force_range(labels, TOY).low == (0.0, -2.0, -6.0)
    mirrored = toy(sequences=SequenceSettings(flips=True))
    assert force_range(labels, mirrored).high == (1.0, 2.0, 0.0)
    assert force_range(labels, toy(force_range="authors")) == AUTHORS
    assert force_range(labels, toy(range_margin=0.5)).low[2] == pytest.approx(-9.0)


STARTS = [np.array([0, 5, 9, 16]), np.array([0, 6])]


def test_sequences_begin_without_contact_and_are_a_function_of_seed_and_step() -> None:
    passes = epoch(STARTS, (0, 1), SequenceSettings(batch=2), seed=3, number=1)
    assert passes.steps(ranks=1) == 2
    seen = []
    for step in range(2):
        one, again = passes.sequences(step), passes.sequences(step)
        assert np.array_equal(one.rows, again.rows)
        for sensor, rows, length in zip(one.sensor, one.rows, one.lengths, strict=True):
            assert rows[0] in STARTS[sensor][:-1]
            assert 2 <= length <= one.rows.shape[1]
            assert np.array_equal(rows[:length], rows[0] + np.arange(length))
            assert (rows[length:] == rows[length - 1]).all()
            seen.append((int(sensor), int(rows[0])))
    assert sorted(seen) == [(0, 0), (0, 5), (0, 9), (1, 0)]


def test_lengths_are_anything_from_two_frames_to_the_longest_press() -> None:
    lengths = {
        max(epoch(STARTS, (0,), SequenceSettings(batch=3), 0, number).sequences(0).lengths)
        for number in range(60)
    }
    assert lengths == set(range(2, 8))


def test_processes_share_a_pass() -> None:
    passes = epoch(STARTS, (0, 1), SequenceSettings(batch=1), seed=0, number=0)
    first = {
        (int(s.sensor[0]), int(s.rows[0, 0]))
        for rank in range(2)
        for step in range(passes.steps(ranks=2))
        for s in [passes.sequences(step, rank, 2)]
    }
    assert len(first) == 4


def test_presses_are_strung_together_within_a_sensor() -> None:
    settings = SequenceSettings(batch=1, presses=2, lengths="whole")
    passes = epoch([np.array([0, 5, 9, 16, 18]), STARTS[1]], (0, 1), settings, seed=1, number=0)
    found = [passes.sequences(step) for step in range(passes.steps(ranks=1))]
    joined = sorted(np.concatenate([s.rows[0] for s in found if s.sensor[0] == 0]).tolist())
    assert joined == list(range(18))
    assert [s.lengths[0] for s in found if s.sensor[0] == 1] == [6]


def _sequences(rows: np.ndarray[Any, Any], **changes: Any) -> Sequences:
    """Return sequences of one sensor, neither mirrored nor superposed."""
    batch, longest = rows.shape
    plain = {"flips": np.zeros((batch, 2), bool), "factors": np.zeros(batch, np.float32)}
    where = {"sensor": np.zeros(batch, np.int64), "added": np.arange(batch)}
    return Sequences(rows=rows, lengths=(longest,) * batch, **(plain | where | changes))


def test_mirroring_a_frame_mirrors_its_shear() -> None:
    presses = noise_presses(1, form="field")
    columns, down = [
        _sequences(np.array([[0]]), flips=np.array([flips]))
        for flips in ((True, False), (False, True))
    ]
    inputs, device = InputSettings(form="field"), torch.device("cpu")
    plain = presses.images[0] / torch.tensor([10.0, 10.0, 1.0])[:, None, None]
    across = frames_of([presses], columns, inputs, device)[0, 0]
    assert torch.equal(across[0], -plain[0].flip(-1))
    assert torch.equal(across[1:], plain[1:].flip(-1))
    assert torch.equal(frames_of([presses], down, inputs, device)[0, 0, 1], -plain[1].flip(-2))
    force = presses.wrench[0] * torch.tensor([-1.0, 1.0, 1.0])
    assert torch.equal(forces_of([presses.wrench], columns, device)[0, 0], force)


def test_superposing_adds_fields_and_forces_without_missing_labels_of_a_press_left_out() -> None:
    factors = np.array([0.5, 0.0, 0.25], np.float32)
    joined = _sequences(np.array([[0], [1], [2]]), added=np.array([1, 2, 0]), factors=factors)
    forces = torch.tensor([[[1.0, 2.0, 3.0]], [[4.0, 5.0, 6.0]], [[torch.nan, 7.0, 8.0]]])
    found = superposed(forces, joined)
    wanted = [[[3.0, 4.5, 6.0]], [[4.0, 5.0, 6.0]], [[torch.nan, 7.5, 8.75]]]
    torch.testing.assert_close(found, torch.tensor(wanted), equal_nan=True)
    several = superposed(torch.stack([forces, 2 * forces]), joined, axis=1)
    torch.testing.assert_close(several[1], 2 * found, equal_nan=True)


def test_only_presses_of_the_same_sensor_are_superposed() -> None:
    settings = SequenceSettings(batch=4, superpose=1.0)
    passes = epoch(STARTS, (0, 1), settings, seed=0, number=0)
    steps = [passes.sequences(step) for step in range(passes.steps(ranks=1))]
    added = [
        (one.sensor[row] == one.sensor[one.added[row]], one.factors[row] > 0)
        for one in steps
        for row in range(settings.batch)
    ]
    assert {joined for same, joined in added if not same} <= {False}
    assert any(joined for _, joined in added)


@pytest.mark.slow
def test_superposed_fields_let_a_model_predict_forces_beyond_its_training() -> None:
    weak = noise_presses(6, form="field")
    shade = -weak.wrench[:, 2] / 10
    images = shade[:, None, None, None] * torch.ones(3, 32, 32)
    weak = replace(weak, images=images, wrench=torch.stack([0 * shade, shade, -shade], dim=1))
    strong = replace(weak, images=1.7 * weak.images, wrench=1.7 * weak.wrench)
    settings = toy(
        input=InputSettings(form="field", field_scale_px=1.0),
        stages=(ForceStageSettings(epochs=60, learning_rate=2e-2, schedule="cosine"),),
        sequences=SequenceSettings(batch=6, lengths="whole"),
        range_margin=0.05,
    )
    wider = replace(settings, sequences=replace(settings.sequences, superpose=0.8))
    off = [
        np.abs(train_force(weak, each).predict(strong) - strong.wrench.numpy())[:, 1:].mean()
        for each in (settings, wider)
    ]
    assert off[1] < 0.5 * off[0]


def _measured(presses: Presses, *axes: int) -> Presses:
    """Return presses with labels on some axes alone, and on none in the first frame."""
    wrench = torch.full_like(presses.wrench, torch.nan)
    wrench[1:, axes] = presses.wrench[1:][:, axes]
    return replace(presses, wrench=wrench)


def test_the_loss_is_the_mean_over_labels_and_others_add_no_gradient() -> None:
    predicted = torch.rand(2, 3, 3, requires_grad=True)
    wanted = torch.rand(2, 3, 3)
    known = torch.rand(2, 3, 3) < 0.5
    known[0, 0, 0], known[1, 1, 1] = True, False
    loss = error(predicted, torch.where(known, wanted, torch.nan), [3, 2])
    loss.backward()
    known[1, 2] = False  # beyond the second sequence
    mean = (predicted.detach() - wanted).abs()[known].mean()
    assert loss.detach().item() == pytest.approx(mean.item())
    assert ((predicted.grad != 0) == known).all()  # type: ignore[union-attr]
    assert error(wanted, torch.full_like(wanted, torch.nan), None).item() == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("box", few(["training", "authors"], 1))
def test_a_model_of_fz_alone_predicts_fz_alone(tmp_path: Path, box: str) -> None:
    presses = noise_presses(2)
    some = _measured(presses, 2)
    settings = toy(
        stages=(ForceStageSettings(epochs=15, learning_rate=2e-2, schedule="cosine"),),
        force_range=box,
    )
    run = _open(tmp_path / "run", settings)
    train_force(some, settings, session(settings, run), validation=_measured(presses, 2))
    model = load_force_model(tmp_path / "run")
    assert model.axes == ("Fz",)
    found, wanted = model.predict(presses), presses.wrench.numpy()
    assert np.isnan(found[:, :2]).all()
    off = np.abs(found - wanted)[:, 2].mean()
    assert off < 0.7 * np.abs(wanted - wanted.mean(axis=0))[:, 2].mean()
    line = json.loads((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()[-1])
    assert line["mae_Fz_n"] > 0
    assert "mae_Fx_n" not in line


def test_unmeasured_axes_leave_no_trace_in_what_is_learned() -> None:
    some = _measured(noise_presses(2), 2)
    other = replace(some, wrench=some.wrench.clone())
    one, two = (train_force(each, toy(start_at_mean=False)) for each in (some, other))
    torch.testing.assert_close(one.state_dict(), two.state_dict(), equal_nan=True)
    # The rows of the last layer that belong to Fx and Fy are as at the beginning.
    begun = initial_model([some.wrench], toy(start_at_mean=False), None, torch.device("cpu"))
    assert torch.equal(one.head.weight[:2], begun.head.weight[:2])
    assert not torch.equal(one.head.weight[2], begun.head.weight[2])


def test_sensors_with_other_gauges_train_one_model_and_those_without_labels_are_left_out() -> None:
    presses = [_measured(noise_presses(2, seed=1), 2), noise_presses(2, seed=2)]
    model = train_force(presses, TOY, validation=[_measured(presses[1]), presses[1]])
    assert model.axes == ("Fx", "Fy", "Fz")
    assert np.isfinite(model.predict(presses[0])).all()


def test_models_trained_together_know_the_axes_of_their_labels() -> None:
    presses = noise_presses(3)
    settings = toy(stages=(ForceStageSettings(epochs=1, learning_rate=1e-2),))
    one, two = train_batched([_measured(presses, 2), presses], settings)  # type: ignore[misc]
    assert (one.axes, two.axes) == (("Fz",), ("Fx", "Fy", "Fz"))
    alone = train_force(_measured(presses, 2), settings)
    assert one.head.weight[2].tolist() == pytest.approx(alone.head.weight[2].tolist(), abs=1e-4)
