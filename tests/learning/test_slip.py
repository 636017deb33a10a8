"""Slip by the coherence of a field's changes."""

import math
from typing import Any

import numpy as np
import pytest

from benchmarks.slip import RATE_HZ, WITHIN, held, slid
from learning.errors import LearningError
from learning.force.slip import Slip, SlipWatch

NOISE = 0.01
PLACES = np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), axis=-1).reshape(-1, 2) - [4, 3]


def grip(middle: Any = (0.0, 0.0), shear: Any = (0.0, 0.0), squeeze: float = 1.0) -> Any:
    """Return the field (63, 2) [px] of a contact: its dent spreads the markers, a load shears."""
    aside = PLACES - np.asarray(middle)
    bump = np.exp(-(aside**2).sum(axis=1, keepdims=True) / 4)
    return bump * (2 * squeeze * aside + np.asarray(shear))


def watched(fields: list[Any], noise: float = NOISE) -> list[Slip | None]:
    """Return the slips seen in fields, after a grip has stood still."""
    rng, watch = np.random.default_rng(0), SlipWatch(noise)
    frames = [np.zeros_like(fields[0])] * 5 + [fields[0]] * 12 + fields
    return [
        watch.update(round(number * 1e9 / 60), field + noise * rng.normal(size=field.shape))
        for number, field in enumerate(frames)
    ]


def test_a_load_a_squeeze_and_rest_are_no_slip() -> None:
    steps = np.linspace(0, 1, 30)
    loads = [grip(shear=(8 * s, 4 * s)) for s in steps]
    loads += [grip(shear=(8 - 16 * s, 4)) for s in steps]
    assert watched(loads) == [None] * len(watched(loads))
    squeezes = [grip(shear=(0, 0), squeeze=1 + 0.3 * s) for s in steps]
    assert not any(watched(squeezes))
    assert not any(watched([grip()] * 60))


def test_a_contact_that_moves_over_the_skin_is_gross_slip_from_the_second_field_on() -> None:
    loaded = [grip(shear=(8 * s, 0)) for s in np.linspace(0, 1, 10)]
    slides = [grip((0.1 * k, 0), (8, 0)) for k in range(1, 9)]
    seen = watched(loaded + slides)[-len(slides) :]
    assert seen[0] is None or not seen[0].gross
    assert all(slip is not None and slip.gross for slip in seen[2:])
    assert [slip.t_ns for slip in seen[2:] if slip] == sorted(
        slip.t_ns for slip in seen[2:] if slip
    )
    # Before the grip has stood still nothing is known to be slip.
    watch = SlipWatch(NOISE)
    assert not any(watch.update(k, grip((0.1 * k, 0))) for k in range(8))


def test_a_contact_that_is_lost_is_a_new_grip() -> None:
    lost = [*([grip()] * 3), *([0 * grip()] * 3), *(grip((k / 4, 0)) for k in range(4))]
    assert not any(watched(lost))


def test_frames_that_are_no_field_are_refused_and_old_ones_left_out() -> None:
    watch = SlipWatch(NOISE)
    with pytest.raises(LearningError, match=r"\(16,\); allowed: finite \(m, 2\)"):
        watch.update(0, np.zeros(16))
    assert watch.update(5, np.zeros((16, 3))) is None
    with pytest.raises(LearningError, match=r"allowed: finite \(16, 3\)"):
        watch.update(6, np.zeros((15, 3)))
    with pytest.raises(LearningError, match="finite"):
        watch.update(6, np.full((16, 3), np.nan))
    assert watch.update(5, np.ones((16, 3))) is None
    for noise in (0.0, math.nan):
        with pytest.raises(LearningError, match="allowed: more than 0"):
            SlipWatch(noise)


def test_simulated_slips_are_noticed_and_a_held_object_does_not_slip() -> None:
    late = [slid("gelsight", seed)[RATE_HZ] for seed in range(4)]
    assert sum(one <= WITHIN for one in late) >= 3, late
    assert [held("gelsight", seed)[1][RATE_HZ] for seed in range(2)] == [0, 0]
