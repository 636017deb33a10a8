"""`python -m benchmarks latency`: accuracy against time, by size, precision and runtime."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from learning.errors import LearningError
from recorder.command_line.options import add_device
from recorder.progress import ItemProgress

if TYPE_CHECKING:
    from benchmarks.learning.latency.costs import Cost, Sample
    from learning.force.model import ForceModel

PRESETS = "paper,tiny,displacement"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Processes frames one by one as from a live sensor and reports the time "
        "per frame and the force error: from labels with --archive, else from torch in fp32. "
        "Models are trained, or presets with random weights, which take the same time."
    )
    parser.add_argument(
        "--model",
        action="append",
        type=Path,
        metavar="MODEL",
        help="a force model (repeatable)",
    )
    parser.add_argument(
        "--presets",
        metavar="NAME,...",
        help=f"presets with random weights, without --model ({PRESETS})",
    )
    parser.add_argument("--archive", type=Path, metavar="ARCHIVE", help="X.markers.zarr, for MAE")
    parser.add_argument("--sensor", metavar="NAME", help="sensor in the archive")
    parser.add_argument("--split", type=Path, metavar="FILE", help="split.json")
    parser.add_argument(
        "--role",
        default="new_indenter",
        metavar="NAME",
        help="role in the split (new_indenter)",
    )
    parser.add_argument("--presses", type=int, default=10, help="number of presses (10)")
    parser.add_argument("--frames", type=int, default=100, help="number of frames to time (100)")
    parser.add_argument("--threads", type=int, default=2, help="CPU threads of a step (2)")
    add_device(parser)
    parser.add_argument(
        "--runtimes", metavar="NAME,...", help="torch, torch.compile, onnxruntime, openvino (all)"
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for bench.csv, bench.md and bench.png"
    )


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    from benchmarks.learning.latency.cost_table import draw, markdown, write_csv
    from benchmarks.learning.latency.costs import VARIANTS, costs

    known = {variant.runtime for variant in VARIANTS}
    wanted = set(options.runtimes.split(",")) if options.runtimes else known
    if not wanted <= known:
        allowed = ", ".join(sorted(known))
        raise LearningError(f"--runtimes: found {options.runtimes}; allowed: {allowed}")
    for name, least in (("presses", 1), ("frames", 1), ("threads", 1)):
        if getattr(options, name) < least:
            raise LearningError(f"--{name}: found {getattr(options, name)}; allowed: 1 and more")
    variants = [variant for variant in VARIANTS if variant.runtime in wanted]
    rows: list[Cost] = []
    # No thread, which would disturb the measurements.
    progress = ItemProgress("variants", sys.stderr, threaded=False)
    for name, model in _models(options).items():
        with tempfile.TemporaryDirectory() as folder, progress:
            rows += costs(
                name,
                model,
                _sample(options, model),
                Path(folder),
                threads=options.threads,
                least_frames=options.frames,
                variants=variants,
                progress=progress,
            )
    print(markdown(rows), end="")
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        write_csv(rows, options.out / "bench.csv")
        (options.out / "bench.md").write_text(markdown(rows), encoding="utf-8")
        draw(rows, options.out / "bench.png")
        print(f"{options.out}: bench.csv, bench.md and bench.png written")
    return 0


def _models(options: argparse.Namespace) -> dict[str, ForceModel]:
    from learning.config import read_settings
    from learning.data.presses import AUTHORS
    from learning.force import ForceModel, load_force_model
    from learning.force.train import PRESETS as PRESET_FOLDER
    from learning.force.train import ForceModelSettings
    from learning.training.run import seed_torch

    def untrained(preset: str) -> ForceModel:
        """Return a model of a preset with random weights and the authors' force range."""
        settings = read_settings(ForceModelSettings, PRESET_FOLDER, preset)
        seed_torch(settings.seed, "force", "weights")
        model = ForceModel(settings.network, settings.input)
        model.set_range(AUTHORS)
        return model.to(options.device).eval()

    if options.model:
        if options.presets:
            raise LearningError("--presets: found with --model; allowed: one of them")
        return {path.name: load_force_model(path, options.device) for path in options.model}
    names = (options.presets or PRESETS).split(",")
    return {name: untrained(name) for name in names}


def _sample(options: argparse.Namespace, model: ForceModel) -> Sample:
    from benchmarks.learning.latency.costs import sample_of, sample_of_noise

    if options.archive is None:
        return sample_of_noise(model, options.presses)
    from learning.data.presses import load_presses
    from learning.data.splits import read_split
    from recorder import MarkerArchive

    if options.sensor is None or options.split is None:
        raise LearningError("--sensor, --split: missing; allowed: both, with --archive")
    archive = MarkerArchive(options.archive)
    split = read_split(options.split)
    split.check(archive)
    table = archive[options.sensor].table
    rows = split.rows(table, options.role)
    form = model.inputs.stored_form
    locations = sorted(set(table["location"][rows].tolist()))
    # Spread evenly, so that a few presses cover several indenters.
    step = max(1, len(locations) // options.presses)
    chosen = locations[::step][: options.presses]
    few = [row for row in rows.tolist() if table["location"][row] in set(chosen)]
    return sample_of(load_presses(archive[options.sensor], few, form=form), model)
