"""Part `latency`: time of force models and error of their precision, by every runtime.

Their error against true forces is that of the benchmark `paper`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.report import Page, Run, table
from learning.config import read_settings
from learning.data.presses import AUTHORS
from learning.errors import LearningError
from learning.force import ForceModel
from learning.force.export import OneFrame, export_onnx, random_frames, torch_stream
from learning.force.stream import ForceStream, open_exported
from learning.force.train import PRESETS as PRESET_FOLDER
from learning.force.train import ForceModelSettings
from learning.training.run import seed_torch
from recorder.charts import SOFT, chart

PRESETS = ("paper", "tiny", "displacement")
# Target rate of a live model.
LIVE_HZ = 60
# Warm-up frames that are not timed.
_WARM_UP = 5
_MARKS = {"fp32": "o", "bf16": "s"}


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
    p50_ms: float | None = None
    """Median time of a frame [ms]; None: this runtime is not available here."""
    p99_ms: float | None = None
    difference_n: float | None = None
    """Largest difference of a force from torch in fp32 [N]."""
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


def measure(run: Run) -> list[dict[str, Any]]:
    """Time each preset in each variant."""
    presets: Sequence[str] = PRESETS
    frames = 100
    variants: Sequence[Variant] = VARIANTS
    if run.quick:  # without compiling
        presets, frames, variants = ("tiny",), 3, (VARIANTS[0], VARIANTS[4])
    rows: list[Cost] = []
    for number, name in enumerate(presets):

        def progress(done: int, total: int, number: int = number) -> None:
            run.progress((number + done / total) / len(presets))

        model = _untrained(name)
        sample = sample_of_noise(model, 10)
        rows += costs(
            name,
            model,
            sample,
            run.folder,
            least_frames=frames,
            variants=variants,
            progress=progress,
        )
    return [asdict(row) for row in rows]


def _untrained(preset: str) -> ForceModel:
    """Return a model of a preset with random weights and the authors' force range."""
    settings = read_settings(ForceModelSettings, PRESET_FOLDER, preset)
    seed_torch(settings.seed, "force", "weights")
    model = ForceModel(settings.network, settings.input)
    model.set_range(AUTHORS)
    return model.eval()


def sample_of_noise(model: ForceModel, count: int) -> Sample:
    """Return synthetic frames, which take as long as real ones."""
    frames = random_frames(model, count + 1)
    needed = model.inputs.needs_reference
    return Sample(frames[1:], np.array([0, count]), frames[:1] if needed else None)


def costs(
    name: str,
    model: ForceModel,
    sample: Sample,
    folder: Path,
    *,
    threads: int = 2,
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
        about = (name, weights, variant.runtime, variant.precision)
        try:
            stream = _stream(variant, model, exported, threads)
            found = _forces(stream, sample)
            times = _times(stream, sample, least_frames) * 1e3
        except (LearningError, ImportError, RuntimeError) as error:
            why = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
            rows.append(Cost(*about, remark=f"does not run: {why[:100]}"))
            continue
        p50, p99 = np.percentile(times, [50, 99]).tolist()
        rows.append(Cost(*about, p50, p99, float(np.abs(found - truth).max())))
    return rows


def _stream(variant: Variant, model: ForceModel, exported: Path, threads: int) -> ForceStream:
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
    times = []
    for number in range(_WARM_UP + max(least_frames, 1)):
        frame = sample.frames[number % len(sample.frames)]
        began = time.perf_counter()
        stream.step(frame)
        times.append(time.perf_counter() - began)
    return np.array(times[_WARM_UP:])


_ABOUT = """\
Frames one by one as from a live sensor, keeping the recurrent state, on two threads. Weights are
random, on which time does not depend. The error is the largest difference of a force from torch in
fp32, that of the precision; errors against true forces are in [paper](paper.md).""".replace(
    "\n", " "
)


def section(rows: list[dict[str, Any]], page: Page) -> str:
    """Return the table of the models, and draw error against time."""
    lines = []
    for row in rows:
        line = [row["model"], f"{row['weights'] / 1e6:.2f} M", row["runtime"], row["precision"]]
        if row["p50_ms"] is None:
            lines.append([*line, row["remark"], "", ""])
            continue
        times = [f"{row['p50_ms']:.1f}", f"{row['p99_ms']:.1f}"]
        lines.append([*line, *times, f"{row['difference_n']:.1e}"])
    head = ["model", "weights", "runtime", "precision", "p50 [ms]", "p99 [ms]", "from fp32 [N]"]
    picture = _draw([row for row in rows if row["p50_ms"] is not None], page)
    return "\n\n".join(["## Latency of force models", _ABOUT, picture, table(head, lines)])


def _draw(rows: list[dict[str, Any]], page: Page) -> str:
    models = list(dict.fromkeys(row["model"] for row in rows))
    runtimes = list(dict.fromkeys(row["runtime"] for row in rows))
    with chart(page.picture("latency"), 9, 3) as figure:
        every = figure.subplots(1, len(runtimes), sharex=True, sharey=True, squeeze=False)[0]
        for axes, runtime in zip(every, runtimes, strict=True):
            for row in rows:
                if row["runtime"] == runtime:
                    colour = f"C{models.index(row['model'])}"
                    mark = _MARKS.get(row["precision"], "D")
                    axes.plot(row["p50_ms"], row["difference_n"], mark, color=colour)
            live = axes.axvline(1e3 / LIVE_HZ, color=SOFT, linestyle=":")
            axes.set(title=runtime, xscale="log", xlabel="time of a frame [ms]")
        every[0].set_yscale("symlog", linthresh=1e-6)
        every[0].set_ylabel("from torch in fp32 [N]")
        marks = [every[0].plot([], [], "o", color=f"C{k}")[0] for k in range(len(models))]
        marks += [every[0].plot([], [], mark, color=SOFT)[0] for mark in _MARKS.values()]
        names = (*models, *_MARKS, f"{LIVE_HZ} Hz")
        figure.legend([*marks, live], names, loc="outside right upper")
    return page.link("latency", "Error of a precision against the time of a frame")
