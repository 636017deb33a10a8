"""Models trained side by side equal those trained alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support.force_models import TOY, noise_presses, toy
from support.training import session

from learning.data.presses import Presses
from learning.errors import LearningError
from learning.force.batched import train_batched
from learning.force.labels import Relabelling, by_twins
from learning.force.model import ForceModel, InputSettings
from learning.force.train import (
    ForceModelSettings,
    ForceStageSettings,
    OptimiserSettings,
    SequenceSettings,
    train_force,
)
from learning.training.run import LaunchSettings
from recorder.archive import Simulated

SETTINGS = toy(
    stages=(
        ForceStageSettings(epochs=2, learning_rate=1e-2, schedule="cosine", warm_up_steps=1),
        ForceStageSettings(epochs=1, learning_rate=1e-3),
    ),
    network=replace(TOY.network, encoder_norm="instance", tail_norm="none"),
    optimiser=OptimiserSettings(name="adamw", weight_decay=0.01, clip=0.05),
    range_margin=0.05,
)


def _shown() -> list[Presses]:
    """Return the same presses as seen by three sensors."""
    return [replace(noise_presses(3, 4, seed=seed), sensor=name) for seed, name in enumerate("abc")]


def _softer(presses: Presses) -> Presses:
    return Relabelling(lambda rows, forces, depth, phase: forces / 2).of(presses)


def same_as_alone(
    presses: list[Presses], settings: ForceModelSettings, start_from: ForceModel | None = None
) -> list[tuple[ForceModel, ForceModel]]:
    """Return each model beside the one trained alone, which predicts the same.

    A bias before a norm has no effect, and Adam moves it by round-off: predictions are compared.
    """
    batched = train_batched(presses, settings, start_from=start_from)
    assert batched is not None
    models = []
    for each, model in zip(presses, batched, strict=True):
        alone = train_force(each, settings, start_from=start_from)
        np.testing.assert_allclose(model.predict(each), alone.predict(each), atol=1e-3)
        models.append((model, alone))
    return models


def test_labels_by_simulation_count_by_their_certainty_alone_and_batched() -> None:
    presses = _shown()[:2]
    count = presses[0].frames
    force = np.tile([0.5, -0.5, -5.0], (count, 1))
    force[::2] *= 0.2
    spread = np.zeros((count, 3))
    spread[::2] = 1e3
    labelled = by_twins(Simulated(force, spread, "")).of(presses[0])
    (_, alone), _ = same_as_alone([labelled, _softer(presses[1])], SETTINGS)
    equal = train_force(by_twins(Simulated(force, 0 * spread, "")).of(presses[0]), SETTINGS)
    # The smaller forces, of which nothing is known, hold the others back.
    assert alone.predict(presses[0])[:, 2].mean() < equal.predict(presses[0])[:, 2].mean()


@pytest.mark.slow
@pytest.mark.parametrize(("begun", "flips"), [(False, False), (True, True)])
def test_each_learns_what_it_would_have_learned_alone(begun: bool, flips: bool) -> None:
    first, second, third = _shown()
    presses = [first, _softer(second), third]
    settings = replace(SETTINGS, sequences=replace(SETTINGS.sequences, flips=flips))
    start = train_force(noise_presses(4, 3, seed=7), settings) if begun else None
    (one, _), _, (other, _) = same_as_alone(presses, settings, start)
    assert not np.allclose(one.predict(presses[0]), other.predict(presses[0]))


def test_sgd_and_many_frames_are_shared_too() -> None:
    settings = toy(
        optimiser=OptimiserSettings(name="sgd", momentum=0.9, weight_decay=1e-3),
        sequences=SequenceSettings(batch=2, presses=2, padding="last_frame"),
    )
    for model, alone in same_as_alone(_shown()[:2], settings):
        torch.testing.assert_close(model.state_dict(), alone.state_dict(), rtol=1e-4, atol=1e-6)


def test_superposed_presses_are_those_of_a_model_alone() -> None:
    settings = replace(
        SETTINGS,
        input=InputSettings(form="field"),
        network=replace(SETTINGS.network, encoder_norm="none", tail_norm="none"),
        sequences=SequenceSettings(batch=3, superpose=1.0),
    )
    presses = [
        replace(noise_presses(3, seed=seed, form="field"), sensor=str(seed)) for seed in (0, 1)
    ]
    same_as_alone(presses, settings)
    with pytest.raises(
        LearningError, match=r"superpose: found 1 with input\.form both; allowed: 0"
    ):
        replace(settings, input=TOY.input)


def test_it_stops_when_it_is_asked_to() -> None:
    seen: list[tuple[int, int]] = []
    stopped = session(SETTINGS, stop_after=2)
    watched = replace(stopped, progress=lambda done, total: seen.append((done, total)))
    assert train_batched(_shown(), SETTINGS, watched) is None
    assert seen == [(1, 6)]


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        (toy(network=replace(TOY.network, tail_norm="batch")), "network.tail_norm"),
        (
            replace(SETTINGS, launch=LaunchSettings(mixed_precision="fp16")),
            "launch.mixed_precision",
        ),
    ],
)
def test_what_models_cannot_share_is_refused(settings: ForceModelSettings, key: str) -> None:
    with pytest.raises(LearningError, match=f"{key}: found a setting that needs one model"):
        train_batched(_shown(), settings)


def test_other_presses_are_refused_and_a_loss_that_is_no_number_names_its_sensor() -> None:
    presses = _shown()
    with pytest.raises(LearningError, match="presses of noise: found others than those of a"):
        train_batched([presses[0], noise_presses(2, 4)], SETTINGS)
    with pytest.raises(LearningError, match="found none"):
        train_batched([], SETTINGS)
    broken = replace(presses[1], references=presses[1].references, wrench=presses[1].wrench * 0)
    settings = replace(SETTINGS, stages=(ForceStageSettings(epochs=2, learning_rate=1e30),))
    with pytest.raises(LearningError, match=r"loss of [abc]: found"):
        train_batched([presses[0], broken], settings)
