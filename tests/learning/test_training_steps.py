"""Steps of a training: stateless randomness, learning rates, devices, Ctrl-C."""

import os
import signal

import numpy as np
import pytest
import torch
from torch import nn

from learning.errors import LearningError
from learning.training.optim import Constant, Cosine, InversePower, set_rate
from learning.training.run import (
    LaunchSettings,
    Stop,
    accelerator,
    batch,
    described,
    generator,
    seed_torch,
)


def test_chance_depends_on_seed_and_words_alone() -> None:
    assert generator(1, "a", 2).random() == generator(1, "a", 2).random()
    different = [(1, "a", 2), (2, "a", 2), (1, "b", 2), (1, "a", 3), (1, "a", "2"), (1, "a2")]
    assert len({generator(*words).random() for words in different}) == len(different)


def test_torch_draws_the_same_after_the_same_words() -> None:
    drawn = []
    for words in (("step", 1), ("step", 2), ("step", 1)):
        seed_torch(5, *words)
        drawn.append(torch.rand(3))
    assert torch.equal(drawn[0], drawn[2])
    assert not torch.equal(drawn[0], drawn[1])


@pytest.mark.parametrize("ranks", [1, 3])
def test_a_pass_sees_everything_once_over_all_processes(ranks: int) -> None:
    size, count = 4, 24
    steps = count // (size * ranks)
    for number in range(2):
        seen = [
            batch(7, number * steps + step, size, count, rank=rank, ranks=ranks)
            for step in range(steps)
            for rank in range(ranks)
        ]
        assert sorted(np.concatenate(seen).tolist()) == list(range(count))


def test_batches_reach_from_one_pass_into_the_next() -> None:
    seen = np.concatenate([batch(0, step, 4, 6) for step in range(3)])
    assert sorted(seen[:6].tolist()) == sorted(seen[6:].tolist()) == list(range(6))
    assert len(batch(0, 0, 10, 3)) == 10
    with pytest.raises(LearningError, match="found 4 of 0"):
        batch(0, 0, 4, 0)


def test_a_rate_is_that_of_the_authors() -> None:
    authors = InversePower(0.1)
    assert authors.at(1000) == pytest.approx(0.1 * 1.3**-0.75)
    assert authors.at(0) == pytest.approx(0.1)


def test_rates_rise_and_fall() -> None:
    rate = Cosine(1.0, steps=110, warm_up=10)
    assert rate.at(0) == pytest.approx(1 / 11)
    assert rate.at(10) == pytest.approx(1.0)
    assert rate.at(60) == pytest.approx(0.5)
    assert rate.at(110) == rate.at(500) == pytest.approx(0.0)
    assert Constant(2.0, warm_up=3).at(1) == pytest.approx(1.0)
    assert Constant(2.0, warm_up=3).at(3) == 2.0
    optimiser = torch.optim.SGD(nn.Linear(1, 1).parameters(), lr=1.0)
    set_rate(optimiser, 0.25)
    assert optimiser.param_groups[0]["lr"] == 0.25


def test_the_device_is_the_one_that_there_is() -> None:
    launched = accelerator(LaunchSettings(device="cpu", mixed_precision="bf16"))
    reported = described(launched)
    assert reported.startswith("cpu (CPU)")
    assert reported.endswith("mixed precision bf16")
    with pytest.raises(LearningError, match="found fp16 on a CPU"):
        accelerator(LaunchSettings(device="cpu", mixed_precision="fp16"))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there_is_an_error() -> None:
    with pytest.raises(LearningError, match="found cuda, and this machine has none"):
        accelerator(LaunchSettings(device="cuda"))


def test_ctrl_c_asks_once_and_ends_at_once_the_second_time() -> None:
    now, reported = [0.0], []
    before = signal.getsignal(signal.SIGINT)
    with Stop(reported.append, clock=lambda: now[0]) as stop:
        assert not stop.requested
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.requested
        # torchrun passes on a signal that the terminal has already sent.
        os.kill(os.getpid(), signal.SIGINT)
        now[0] = 5.0
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert len(reported) == 1
    assert signal.getsignal(signal.SIGINT) == before


def test_one_process_stops_when_it_was_asked() -> None:
    launched = accelerator(LaunchSettings(device="cpu"))
    stop = Stop()
    assert not stop.agreed(launched)
    stop.requested = True
    assert stop.agreed(launched)
