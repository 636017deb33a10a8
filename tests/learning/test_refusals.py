"""Values and settings that mean nothing: errors state the place, the value and the allowed ones."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from support.force_models import TOY
from support.predicted_forces import TRUE, predictions

from learning.compensation.prior import ForceDepthCurve, compensate, fit_prior
from learning.config import read_settings
from learning.data.images import warp
from learning.data.matching import Tolerances
from learning.data.presses import ForceRange
from learning.errors import LearningError
from learning.evaluation.distribution import frechet_distance, squared_kernel_distance
from learning.evaluation.predictions import merged
from learning.experiment import settings as experiment
from learning.force import train as force
from learning.force.model import prepare
from learning.markers import Segmenter, preset
from learning.markers.displacement import FieldReader
from learning.metrics import force_errors
from learning.training.optim import Constant, Cosine, InversePower

DEPTH = np.linspace(0.1e-3, 1.2e-3, 12)
SOME, ONE = np.zeros((5, 3)), np.ones(4)
FIELD = torch.zeros(1, 1, 64, 64), torch.zeros(1, 2, 32, 32)


def curve(depth: Any, force: Any) -> object:
    points = np.stack([depth, force], axis=1)
    return fit_prior(ForceDepthCurve("skin", "prism", "made up", points, points))


def compensated(phase: int = 0, d0: float = 0.0, lam: float = 1.0) -> object:
    soft = curve(DEPTH, 1e3 * DEPTH)
    return compensate(np.ones((12, 3)), DEPTH, np.full(12, phase), soft, soft, d0, lam)


def experiments(changed: str) -> object:
    return read_settings(experiment.ExperimentSettings, experiment.PRESETS, "demo", [changed])


def forces(changed: str) -> object:
    return read_settings(force.ForceModelSettings, force.PRESETS, "tiny", [changed])


def prepared(*shape: int, dtype: torch.dtype = torch.uint8) -> object:
    return prepare(torch.zeros(shape, dtype=dtype), None, TOY.input)


def masked(kind: str, *shape: int) -> object:
    return Segmenter(preset("bench-gelsight")).mask(np.zeros(shape, kind))


def row_1(value: float) -> Any:
    changed = TRUE.copy()
    changed[1, 0] = value
    return changed


WRONG: dict[str, Callable[[], object]] = {
    "prior skin.loading: found forces at 2 depths": lambda: curve(DEPTH[:2], DEPTH[:2]),
    "prior skin.loading: found NaN": lambda: curve(DEPTH, DEPTH * np.nan),
    "(compression is negative Fz)": lambda: curve(DEPTH, -1e3 * DEPTH),
    "phase: found -1 in row 0": lambda: compensated(phase=-1),
    "d0: found 1.5; allowed: 0 to 1": lambda: compensated(d0=1.5),
    "lambda: found nan; allowed: 0 to 1": lambda: compensated(lam=np.nan),
    "found 32 x 32; allowed: 57 x 73": lambda: warp(*FIELD),
    "reference: found no marker": lambda: FieldReader(np.zeros((480, 640), np.bool_)),
    "force range: found": lambda: ForceRange.from_training(np.full((2, 3), np.nan)),
    "low < high": lambda: ForceRange((0.0, 0.0, 0.0), (1.0, 0.0, 1.0)),
    "one frame or more": lambda: force_errors(TRUE[:0], TRUE[:0], ONE),
    "no label that a prediction can be": lambda: force_errors(TRUE * np.nan, TRUE, ONE),
    "in row 1 of true": lambda: force_errors(row_1(np.inf), TRUE, ONE),
    "row 1 of predicted": lambda: force_errors(TRUE, row_1(np.nan), ONE),
    "row 0 twice": lambda: merged([predictions(), predictions(off=0.1)]),
    "2 samples or more": lambda: frechet_distance(SOME[:1], SOME),
    "not numbers": lambda: frechet_distance(SOME * np.nan, SOME),
    "features: found": lambda: squared_kernel_distance(SOME, np.zeros((5, 4))),
    "translators: found": lambda: experiments("translators=[]"),
    "each once": lambda: experiments("translators=[flow, flow]"),
    "models_per_batch: found 0": lambda: experiments("models_per_batch=0"),
    "train_presses: found 0; allowed: 1 or more": lambda: experiments("train_presses=0"),
    "scored_presses: found -1": lambda: experiments("scored_presses=-1"),
    "side_px: found 100": lambda: forces("input.side_px=100"),
    "memory: found 0": lambda: forces("network.memory=0"),
    "3 if form is image": lambda: forces("input.channels=3"),
    "stages: found none": lambda: forces("stages=[]"),
    "batch: found 0": lambda: forces("sequences.batch=0"),
    "frames: found (2, 128, 128) uint8": lambda: prepared(2, 128, 128),
    "float32; allowed": lambda: prepared(2, 256, 256, dtype=torch.float32),
    "reference: missing": lambda: prepared(2, 256, 256),
    "picture: found uint8 (480, 640); allowed: uint8": lambda: masked("u1", 480, 640),
    "picture: found uint8 (480, 640, 4); allowed: uint8": lambda: masked("u1", 480, 640, 4),
    "picture: found float32 (480, 640, 3); allowed: uint8": lambda: masked("f4", 480, 640, 3),
    "place: found": lambda: Tolerances(place=0.0),
    "angle: found": lambda: Tolerances(angle=4.0),
    "depth_fraction: found nan": lambda: Tolerances(depth_fraction=np.nan),
    "depth_fraction: found 1.0": lambda: Tolerances(depth_fraction=1.0),
    "schedule: found rate -1.0": lambda: Constant(rate=-1.0),
    "cosine: found steps 5, warm_up 5; allowed": lambda: Cosine(rate=1.0, steps=5, warm_up=5),
    "schedule: found rate 1.0, warm_up -1": lambda: InversePower(rate=1.0, warm_up=-1),
}


@pytest.mark.parametrize("message", WRONG)
def test_what_means_nothing_is_refused_with_its_place(message: str) -> None:
    with pytest.raises(LearningError) as refused:
        WRONG[message]()
    assert message in str(refused.value)
