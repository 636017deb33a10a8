"""The paper's chain, trained from nothing in minutes, beside simple baselines.

    python -m benchmarks paper-chain --out runs/paper [--size all] [--gpus 0,1]

Simulates three sensors with different markers on one skin, and twelve patterns. Trains the marker
autoencoder, the one-step latent translator from pattern to pattern and then from sensor to sensor,
and the paper's force net on translated frames. Beside it: our field translator, the nearest frame,
a net of marker displacement without a translator, the source's net as it is; and force nets of four
sizes. The rows go to CSV files. Jobs run one at a time on each GPU; a repeated command goes on.
Other sizes have other sensors; `--size all` makes the five of the paper's tables and figures.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from learning.errors import LearningError

if TYPE_CHECKING:
    from benchmarks.learning.tables.on_gpus import Task


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.description = __doc__.split("\n\n")[0]
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder")
    parser.add_argument(
        "--size",
        default="homogeneous",
        metavar="NAME",
        help="homogeneous, skins, hysteresis, heterogeneous, material, brief or toy (%(default)s); "
        "all: the first five, each in its folder of DIR",
    )
    parser.add_argument(
        "--minutes",
        type=float,
        metavar="N",
        help="training time of the translator; others get parts of it (1 to 2.5, by size)",
    )
    parser.add_argument("--gpus", metavar="N,...", help="GPU numbers, or `cpu` (all GPUs)")
    parser.add_argument(
        "--per-gpu",
        type=int,
        default=1,
        metavar="N",
        help="jobs at a time on a GPU; one takes up to 18 GiB (%(default)s)",
    )
    parser.add_argument(
        "--processes", type=int, metavar="N", help="processes that simulate or track (all cores)"
    )
    parser.add_argument("--only", metavar="NAME,...", help="jobs, without those they need (all)")
    parser.add_argument(
        "--stop-after", type=int, metavar="SECONDS", help="stop then; the same command goes on"
    )
    parser.add_argument("--job", metavar="NAME", help="run one job in this process")


def run(options: argparse.Namespace) -> int:
    """Run all jobs that are not done; return 0, or 1 if one failed."""
    from benchmarks.learning.paper_chain import jobs, page
    from benchmarks.learning.paper_chain.sizes import SIZES
    from benchmarks.learning.tables.on_gpus import Machine, _gpus, done_in, run_on

    if options.size == "all":
        return run_all(options)
    if options.size not in SIZES:
        raise LearningError(f"--size: found {options.size}; allowed: {', '.join(SIZES)}, all")
    size, out = SIZES[options.size], options.out
    if options.minutes is None:
        options.minutes = size.minutes
    if options.minutes <= 0:
        raise LearningError(f"--minutes: found {options.minutes:g}; allowed: above 0")
    cores = options.processes or len(os.sched_getaffinity(0))
    if options.job is not None:
        import torch

        # A job's time is the GPU's; on a CPU it takes the cores that there are.
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
        # Images have one shape; sequences of force nets have many, for each of which it searches.
        torch.backends.cudnn.benchmark = options.job.startswith(("vae", "m2m"))
        chain = jobs.Chain(out, size, options.minutes, device, max(1, cores // 2))
        jobs.run_job(chain, options.job)
        return 0
    gpus = options.gpus.split(",") if options.gpus else _gpus()[0]
    due = _tasks(options, cores, done_in(out))
    complete = run_on(due, Machine(gpus, options.per_gpu), out, options.stop_after)
    page.write(out, size)
    if "weights" in done_in(out):
        print(f"nets of the sensors' own labels, for --model: {out / 'weights'}")
    print(page.last_line(out, size))
    return int(not complete)


def run_all(options: argparse.Namespace) -> int:
    """Run the sizes of the paper's tables one after the other; one that is not complete ends it."""
    from benchmarks.learning.paper_chain.sizes import ALL

    if options.job or options.only:
        raise LearningError("--job, --only: found with --size all; allowed with one size")
    over = None if options.stop_after is None else time.monotonic() + options.stop_after
    for size in ALL:
        left = None if over is None else max(1, round(over - time.monotonic()))
        print(f"{size}, in {options.out / size}", flush=True)
        one = {**vars(options), "size": size, "out": options.out / size, "stop_after": left}
        if run(argparse.Namespace(**one)):
            return 1
    return 0


def _row(sensor: str) -> str:
    """Return a sensor as `sim archive` takes it: the file beside this one, or the package's."""
    own = Path(__file__).with_name(f"{sensor}.yaml")
    return str(own) if own.exists() else sensor


def _tasks(options: argparse.Namespace, cores: int, done: set[str]) -> list[Task]:
    from benchmarks.learning.paper_chain import jobs
    from benchmarks.learning.paper_chain.sizes import SIZES
    from benchmarks.learning.tables.on_gpus import Task

    size, out = SIZES[options.size], options.out
    made: tuple[str, ...] = ("--tier", size.tier, "--no-check")
    on_gpu = options.gpus != "cpu" and size.tier == "fem"
    made += ("--device", "cuda:0") if on_gpu else ()
    made += ("--processes", str(cores // 2 if on_gpu else cores))
    simulated = {
        f"archive {name}": (
            *(",".join(map(_row, sensors)), *size.archive, *made),
            *("--out", jobs.archive_file(name)),
        )
        for name, sensors in size.archives.items()
    }
    if size.patterns is not None:
        states = (*size.patterns, *made, "--out", jobs.archive_file("patterns"))
        simulated = {"archive patterns": states, **simulated}
    trained = jobs.names(size)
    known = (*simulated, *trained)
    wanted = {*(options.only.split(",") if options.only else known)}
    if unknown := wanted - {*known}:
        words = ", ".join(sorted(unknown))
        raise LearningError(f"--only: found {words}; allowed: {', '.join(known)}")
    wanted -= done
    # Jobs share a GPU's machine; on a CPU a job takes what it finds.
    few = () if options.gpus == "cpu" else (("OMP_NUM_THREADS", str(max(1, cores // 8))),)
    found = []
    for name, (kind, *given) in simulated.items():
        if name in wanted:
            *most, file = given
            command = [
                sys.executable,
                "-m",
                "tactile",
                "sim",
                "archive",
                kind,
                *most,
                str(out / file),
            ]
            one = (("OMP_NUM_THREADS", "1"),)
            found.append(Task(name, tuple(command), (), one, int(on_gpu)))
    for name, needed in trained.items():
        if name in wanted:
            command = [sys.executable, "-m", "benchmarks", "paper-chain", "--out", str(out)]
            command += ["--size", options.size, "--minutes", str(options.minutes), "--job", name]
            command += ["--processes", str(cores)]
            needs = tuple(each for each in needed if each in wanted)
            found.append(Task(name, tuple(command), needs, few, 1))
    return found
