"""Accuracy against time for a model in every precision, by every runtime."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from learning.data.presses import Presses
from learning.errors import LearningError
from learning.force.export import (
    OneFrame,
    export_onnx,
    random_frames,
    torch_stream,
)
from learning.force.model import ForceModel
from learning.force.stream import ForceStream, open_exported

# Warm-up frames that are not timed.
WARM_UP = 5


@dataclass(frozen=True, slots=True)
class Variant:
    """One combination of runtime and precision."""

    runtime: str
    precision: str


VARIANTS = (
    Variant("torch", "fp32"),
    Variant("torch", "bf16"),
    Variant("torch.compile", "fp32"),
    Variant("torch.compile", "bf16"),
    Variant("onnxruntime", "fp32"),
    Variant("openvino", "fp32"),
    Variant("openvino", "bf16"),
)


@dataclass(frozen=True, slots=True)
class Cost:
    """One row of the table."""

    model: str
    weights: int
    """Number of weights."""
    runtime: str
    precision: str
    threads: int
    p50_ms: float | None
    """Median time of a frame [ms]; None: this runtime is not available here."""
    p99_ms: float | None
    rate_hz: float | None
    """Frames per second, processed one after the other."""
    difference_n: float | None
    """Largest difference of a force from torch in fp32 [N]."""
    mae_n: float | None
    """Mean absolute error of Fx, Fy, Fz [N]; None: no labelled presses were given."""
    remark: str = ""


@dataclass(frozen=True, slots=True)
class Sample:
    """Frames that are timed and compared: presses, one after the other."""

    frames: NDArray[np.uint8] | NDArray[np.float32]
    """Frames in the model's input format (n, ...)."""
    starts: NDArray[np.int64]
    """First frame of each press, followed by n."""
    references: NDArray[np.uint8] | None
    """Undeformed image of each press (P, 256, 256), if the model needs it."""
    forces: NDArray[np.float64] | None
    """Labels (n, 3) N, if available."""


def sample_of(presses: Presses, model: ForceModel) -> Sample:
    """Return labelled presses as a sample."""
    some = presses.to("cpu")
    some.require_wrench()
    first = some.reference[some.starts[:-1]]
    needed = model.inputs.needs_reference
    return Sample(
        some.images.numpy(),
        some.starts.numpy(),
        some.references[first].numpy() if needed else None,
        some.wrench.double().numpy(),
    )


def sample_of_noise(model: ForceModel, count: int) -> Sample:
    """Return synthetic frames without labels, which take as long as real ones."""
    frames = random_frames(model, count + 1)
    needed = model.inputs.needs_reference
    return Sample(frames[1:], np.array([0, count]), frames[:1] if needed else None, None)


def costs(
    name: str,
    model: ForceModel,
    sample: Sample,
    folder: Path,
    *,
    threads: int,
    least_frames: int = 100,
    variants: Sequence[Variant] = VARIANTS,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Cost]:
    """Return the cost of running a model in each variant.

    Args:
        name: Name of the model in the table.
        model: The model, on the CPU or another device; exported ones run on the CPU.
        sample: Frames to process.
        folder: Folder for temporary exported models.
        threads: Threads of a step on the CPU.
        least_frames: Minimum number of frames to time; the sample is repeated.
        variants: Variants to measure.
        progress: Called with the number of variants done and the total.
    """
    torch.set_num_threads(threads)
    exported = folder / f"{name}.onnx"
    export_onnx(model, exported)
    weights = sum(weight.numel() for weight in model.parameters())
    truth = _forces(torch_stream(model), sample)
    rows = []
    for done, variant in enumerate(variants):
        progress(done, len(variants))
        about = (name, weights, variant.runtime, variant.precision, threads)
        try:
            stream = _stream(variant, model, sample, exported, threads)
            found = _forces(stream, sample)
            taken = np.sort(_times(stream, sample, least_frames)) * 1e3
        except (LearningError, ImportError, RuntimeError) as error:
            why = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            rows.append(Cost(*about, None, None, None, None, None, f"does not run: {why[:100]}"))
            continue
        p50, p99 = float(np.percentile(taken, 50)), float(np.percentile(taken, 99))
        rate = 1e3 / float(taken.mean())
        mae = None if sample.forces is None else float(np.abs(found - sample.forces).mean())
        rows.append(Cost(*about, p50, p99, rate, float(np.abs(found - truth).max()), mae))
    progress(len(variants), len(variants))
    return rows


def _stream(
    variant: Variant, model: ForceModel, sample: Sample, exported: Path, threads: int
) -> ForceStream:
    if variant.runtime in ("torch", "torch.compile"):
        narrow = variant.precision == "bf16"
        one = OneFrame(_bf16(model) if narrow else model).eval()
        if variant.runtime == "torch.compile":
            torch.compiler.reset()
            one.compile(dynamic=False)
        return torch_stream(model, one)
    runtime = "onnx" if variant.runtime == "onnxruntime" else variant.runtime
    if variant.precision == "bf16":
        runtime += "-bf16"
    return open_exported(exported, runtime=runtime, threads=threads)


def _bf16(model: ForceModel) -> ForceModel:
    """Return a copy of the model with weights in bfloat16, but unchanged force limits."""
    copy = ForceModel(model.network, model.inputs)
    copy.load_state_dict(model.state_dict())
    copy = copy.to(model.device, torch.bfloat16)
    copy.low, copy.high = model.low, model.high
    return copy.eval()


def _forces(stream: ForceStream, sample: Sample) -> NDArray[np.float64]:
    """Return the forces (n, 3) N of a sample."""
    found = []
    for press, (first, end) in enumerate(zip(sample.starts, sample.starts[1:], strict=False)):
        stream.reset(None if sample.references is None else sample.references[press])
        found += [stream.step(frame) for frame in sample.frames[first:end]]
    return np.array(found)


def _times(stream: ForceStream, sample: Sample, least_frames: int) -> NDArray[np.float64]:
    """Return the time per frame (n,) s, after a few warm-up frames."""
    if sample.references is not None:
        stream.reset(sample.references[0])
    taken = []
    for number in range(WARM_UP + max(least_frames, 1)):
        frame = sample.frames[number % len(sample.frames)]
        began = time.perf_counter()
        stream.step(frame)
        taken.append(time.perf_counter() - began)
    return np.array(taken[WARM_UP:])
