"""Part `latency`: time of force models and error of their precision, by every runtime.

Their error against true forces is that of the benchmark `paper`.
"""

import time
from collections.abc import Sequence
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
# Frames whose forces are compared, warm-up frames that are not timed, and threads of a step.
_COMPARED, _WARM_UP, _THREADS = 10, 5, 2
_MARKS = {"fp32": "o", "bf16": "s"}
# Runtime and precision.
VARIANTS = (
    ("torch", "fp32"),
    ("torch", "bf16"),
    ("torch.compile", "fp32"),
    ("torch.compile", "bf16"),
    ("onnxruntime", "fp32"),
    ("openvino", "fp32"),
    ("openvino", "bf16"),
)


def measure(run: Run) -> list[dict[str, Any]]:
    """Time each preset in each variant."""
    presets, frames, variants = list(PRESETS), 100, list(VARIANTS)
    if run.quick:  # without compiling
        presets, frames, variants = ["tiny"], 3, [VARIANTS[0], VARIANTS[4]]
    rows: list[dict[str, Any]] = []
    for number, preset in enumerate(presets):
        run.progress(number / len(presets))
        # Random weights, and the authors' force range.
        settings = read_settings(ForceModelSettings, PRESET_FOLDER, preset)
        seed_torch(settings.seed, "force", "weights")
        model = ForceModel(settings.network, settings.input)
        model.set_range(AUTHORS)
        rows += costs(preset, model.eval(), run.folder, variants, frames)
    return rows


def costs(
    name: str, model: ForceModel, folder: Path, variants: Sequence[tuple[str, str]], count: int
) -> list[dict[str, Any]]:
    """Return the cost of running a model in each variant (runtime, precision), on random frames.

    For each the number of `weights`, the median and 99th percentile of the time of one of `count`
    frames [ms], and the largest difference of a force from torch in fp32 [N]; None and a `remark`
    if the runtime is not available here. The model is exported to `folder`.
    """
    torch.set_num_threads(_THREADS)
    exported = folder / f"{name}.onnx"
    export_onnx(model, exported)
    weights = sum(weight.numel() for weight in model.parameters())
    frames = random_frames(model, _COMPARED + 1)
    truth = _forces(torch_stream(model), model, frames)
    rows = []
    for runtime, precision in variants:
        row = {"model": name, "weights": weights, "runtime": runtime, "precision": precision}
        rows.append(row | {"p50_ms": None, "p99_ms": None, "difference_n": None, "remark": ""})
        try:
            stream = _stream(runtime, precision, model, exported)
            forces = _forces(stream, model, frames)
            times = _times_ms(stream, frames[1:], count)
        except (LearningError, ImportError, RuntimeError) as error:
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            rows[-1]["remark"] = f"does not run: {reason[:100]}"
            continue
        p50, p99 = np.percentile(times, [50, 99]).tolist()
        difference = float(np.abs(forces - truth).max())
        rows[-1] |= {"p50_ms": p50, "p99_ms": p99, "difference_n": difference}
    return rows


def _stream(runtime: str, precision: str, model: ForceModel, exported: Path) -> ForceStream:
    if not runtime.startswith("torch"):
        name = "onnx" if runtime == "onnxruntime" else runtime
        narrow = "" if precision == "fp32" else f"-{precision}"
        return open_exported(exported, runtime=name + narrow, threads=_THREADS)
    one = OneFrame(_bf16(model) if precision == "bf16" else model).eval()
    if runtime == "torch.compile":
        torch.compiler.reset()
        one.compile(dynamic=False)
    return torch_stream(model, one)


def _bf16(model: ForceModel) -> ForceModel:
    """Return a copy of the model with weights in bfloat16, but unchanged force limits."""
    copy = ForceModel(model.network, model.inputs)
    copy.load_state_dict(model.state_dict())
    copy = copy.to(model.device, torch.bfloat16)
    copy.low, copy.high = model.low, model.high
    return copy.eval()


def _forces(stream: ForceStream, model: ForceModel, frames: np.ndarray) -> NDArray[np.float64]:
    """Return the forces (n - 1, 3) N of a press; its first frame is the one without contact."""
    stream.reset(frames[0] if model.inputs.needs_reference else None)
    return np.array([stream.step(frame) for frame in frames[1:]])


def _times_ms(stream: ForceStream, frames: np.ndarray, count: int) -> NDArray[np.float64]:
    """Return the time per frame (count,) ms, after a few warm-up frames."""
    times = []
    for number in range(_WARM_UP + count):
        began = time.perf_counter()
        stream.step(frames[number % len(frames)])
        times.append(1e3 * (time.perf_counter() - began))
    return np.array(times[_WARM_UP:])


_ABOUT = """\
Frames one by one as from a live sensor, keeping the recurrent state, on two threads. Weights are
random, on which time does not depend. The error is the largest difference of a force from torch in
fp32, that of the precision; errors against true forces are in [paper](paper.md)."""


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
            axes.set(title=runtime, xscale="log", xlabel="p50 time of a frame [ms]")
        every[0].set_yscale("symlog", linthresh=1e-6)
        every[0].set_ylabel("from torch in fp32 [N]")
        marks = [every[0].plot([], [], "o", color=f"C{k}")[0] for k in range(len(models))]
        marks += [every[0].plot([], [], mark, color=SOFT)[0] for mark in _MARKS.values()]
        names = (*models, *_MARKS, f"{LIVE_HZ} Hz")
        figure.legend([*marks, live], names, loc="outside right upper")
    return page.link("latency", "Error of a precision against the time of a frame")
