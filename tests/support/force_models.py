"""Small force models and random presses for tests."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from learning.data.presses import ForceRange, Presses
from learning.force.model import KIND, ForceModel, ForceNetworkSettings, InputSettings
from learning.force.train import (
    ForceModelSettings,
    ForceStageSettings,
    OptimiserSettings,
    SequenceSettings,
)
from learning.training.run import RunFolder

TOY = ForceModelSettings(
    description="a few thousand weights",
    input=InputSettings(form="both", side_px=32),
    network=ForceNetworkSettings(
        encoder=(4, 4, 8), blocks=1, memory=8, tail=(8, 8), encoder_norm="none", tail_norm="none"
    ),
    stages=(ForceStageSettings(epochs=2, learning_rate=1e-2),),
    optimiser=OptimiserSettings(weight_decay=0.0),
    sequences=SequenceSettings(batch=2),
    patience_epochs=None,
)


# A force model of an experiment, small enough to train in a second.
TINY_FORCE = (
    'force={preset: tiny, set: ["input.side_px=32", "network.encoder=[4, 4, 4]", '
    '"network.memory=4", "network.tail=[4, 4]", "stages=[{epochs: 1, learning_rate: 0.001}]"]}'
)


def toy(**changes: Any) -> ForceModelSettings:
    """Return the toy settings with some values replaced."""
    return replace(TOY, **changes)


def random_model(folder: Path, form: str, preset: str, *, alone: bool = False) -> Path:
    """Write the folder of a model with random weights, made for the markers of a preset."""
    torch.manual_seed(0)
    inputs = InputSettings(form=form, side_px=32, alone=alone)  # type: ignore[arg-type]
    model = ForceModel(TOY.network, inputs)
    model.set_range(ForceRange((-4.0, -4.0, -18.0), (4.0, 4.0, 1.0)))
    sensor = "uskin" if preset == "uskin" else "gelsight"
    metadata = {"sensors": [sensor], "presets": {sensor: preset}}
    run = RunFolder.open(folder, KIND, toy(input=inputs), "random", metadata=metadata)
    run.finish(0, {"model": model})
    return folder


def noise_presses(
    count: int = 3, frames: int = 4, *, seed: int = 0, form: str = "images"
) -> Presses:
    """Return presses of noise whose force is the fraction of markers in their images."""
    random = torch.Generator().manual_seed(seed)
    lengths = torch.tensor([frames + press % 2 for press in range(count)])
    starts = torch.cat([torch.zeros(1, dtype=torch.int64), lengths.cumsum(0)])
    total = int(starts[-1])
    shade = torch.rand(total, generator=random)
    if form == "field":
        images = torch.randn(total, 3, 32, 32, generator=random) * 5 + shade[:, None, None, None]
    else:
        coarse = (torch.rand(total, 64, 64, generator=random) < shade[:, None, None]) * 255
        images = coarse.to(torch.uint8).repeat_interleave(4, 1).repeat_interleave(4, 2)
    within = torch.cat([torch.arange(int(length)) for length in lengths])
    return Presses(
        sensor="noise",
        mm_per_px=0.03,
        form=form,  # type: ignore[arg-type]
        images=images,
        references=torch.randint(0, 256, (1, 256, 256), generator=random, dtype=torch.uint8),
        reference=torch.zeros(total, dtype=torch.int64),
        wrench=torch.stack([shade - 0.5, 0.5 - shade, -10 * shade], dim=1),
        starts=starts,
        location=torch.arange(count),
        indenter=torch.zeros(count, dtype=torch.int64),
        target=torch.arange(count),
        phase=torch.zeros(total, dtype=torch.int64),
        depth=shade.double() * 1e-3,
        frame=within,
        rows=torch.arange(total),
    )
