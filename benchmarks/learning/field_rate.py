"""Speed of the field translator with untrained weights.

    python -m benchmarks field-speed --device cuda --batch 128

Frames per second of the networks alone (256 x 256 in memory), of translation (masks of 480 x 640
in and out), and of training both stages; and the GPU memory used by training.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import torch

from learning.config import read_settings
from learning.data.images import shrink_masks
from learning.training.run import Session, accelerator, generator
from learning.translation.field.data import Frames, distances_of, random_shifts
from learning.translation.field.network import FieldModel
from learning.translation.field.train import PRESETS, FieldSettings, train_field
from learning.translation.field.translator import FieldTranslator
from recorder.command_line.options import add_device
from recorder.markers import HEIGHT, WIDTH

_SECONDS = 3.0
_PITCH_PX, _RADIUS_PX = 64, 14


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.description = "Frames per second of the field translator."
    parser.add_argument("--preset", default="ours", help="preset of the networks (%(default)s)")
    add_device(parser)
    parser.add_argument("--batch", type=int, default=64, help="batch size (%(default)s)")
    parser.add_argument("--steps", type=int, default=30, help="steps of each stage (%(default)s)")


def run(options: argparse.Namespace) -> int:
    """Measure and print the speed."""
    sets = [
        f"launch.device={options.device}",
        *(
            f"{stage}.{key}={value}"
            for stage in ("field_stage", "map_stage")
            for key, value in (("steps", options.steps), ("batch", options.batch))
        ),
    ]
    settings = read_settings(FieldSettings, PRESETS, options.preset, sets)
    device = torch.device(options.device)
    frames = _frames(options.batch, device)
    model = FieldModel(settings).to(device).eval()
    sizes = [sum(each.numel() for each in net.parameters()) for net in (model.net, model.map)]
    print(f"{options.preset}: field net {sizes[0] / 1e6:.2f} M, map {sizes[1] / 1e6:.2f} M weights")
    rows = torch.arange(options.batch, device=device)
    seen, distance, scale = frames.seen(rows), frames.distance(rows), frames.scale(rows)
    with torch.no_grad():
        rate = _rate(lambda: model(seen, distance, distance, scale, scale), options.batch, device)
    print(f"networks: {rate:,.0f} frames/s")
    translator, mask = FieldTranslator("untrained", model), _reference(device)
    masks = mask.expand(options.batch, -1, -1).contiguous()
    rate = _rate(lambda: translator.translate(masks, mask, mask), options.batch, device)
    print(f"translate: {rate:,.0f} frames/s")
    began: dict[int, float] = {}

    def note(done: int, total: int) -> None:
        _wait(device)
        began[done] = time.perf_counter()

    train_field(frames, settings, session=Session(accelerator(settings.launch), progress=note))
    for stage, first in (("field", 0), ("map", options.steps)):
        # Kernels are selected during the first steps.
        early, last = first + max(1, options.steps // 3), first + options.steps
        rate = (last - early) * options.batch / (began[last] - began[early])
        print(f"training, {stage} stage: {rate:,.0f} frames/s")
    if device.type == "cuda":
        print(f"memory: {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB")
    return 0


def _frames(count: int, device: torch.device) -> Frames:
    """Return undeformed frames of two equal sensors."""
    mask = _reference(device)
    every = torch.arange(count, device=device)
    return Frames(
        images=shrink_masks(mask[None]).expand(count, -1, -1).contiguous(),
        sensor=every % 2,
        reference=every % 2,
        distances=distances_of(mask.cpu().numpy()[None], device).expand(2, -1, -1, -1),
        scales=torch.full((2, 2), 0.03, device=device),
        pairs=torch.stack([every, every.flip(0)], dim=1),
        shift=random_shifts(count, generator(0, "rate"), device).half(),
    )


def _reference(device: torch.device) -> torch.Tensor:
    """Return a mask (480, 640) of discs on a lattice."""
    rows = torch.arange(HEIGHT, device=device)[:, None] % _PITCH_PX - _PITCH_PX // 2
    columns = torch.arange(WIDTH, device=device)[None] % _PITCH_PX - _PITCH_PX // 2
    return rows**2 + columns**2 < _RADIUS_PX**2


def _rate(work: Callable[[], Any], count: int, device: torch.device) -> float:
    """Return frames per second."""
    work()
    _wait(device)
    began, done = time.perf_counter(), 0
    while time.perf_counter() - began < _SECONDS:
        work()
        _wait(device)
        done += count
    return done / (time.perf_counter() - began)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
