"""Forces on new indenters without a gauge on the target, beside what each method needs of it.

    python -m benchmarks gauge-tables --out runs/heterogeneous --group heterogeneous [--gpus 0,1]
    python -m benchmarks gauge-tables --out runs/toy --size toy --gpus cpu --minutes 0.3

Plants sensors whose skins, mounting and cameras differ from their designs, solves their presses by
tier `fem`, and identifies a twin of each by gauge presses under the errors of a bench. Then trains,
for several seeds and all pairs of sensors, nets that see no label of the target, and others that
see a few or all. Tested on indenters that no training, twin or choice has seen. In simulation. Jobs
run in parallel on all GPUs; a repeated command goes on where it stopped.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from learning.errors import LearningError
from recorder.command_line.options import names as listed
from recorder.command_line.options import positive, whole

if TYPE_CHECKING:
    from benchmarks.learning.gauge_tables.jobs import Study
    from benchmarks.learning.tables.on_gpus import Task

# Fewest targets of an indenter that an archive can have.
FEWEST_TARGETS = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    from benchmarks.learning.gauge_tables.skins import GROUPS
    from sim.result import ContactTier

    parser.description = __doc__.split("\n\n")[0]
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="output folder")
    add("--group", choices=tuple(GROUPS), default="heterogeneous", help="(%(default)s)")
    add("--size", choices=("gpu", "toy"), default="gpu", help="(%(default)s)")
    add(
        "--fit",
        choices=get_args(ContactTier),
        default="layer",
        help="tier of twins, their labels and draws (%(default)s)",
    )
    add("--seeds", type=listed, default=("0", "1", "2"), metavar="N,...", help="(0,1,2)")
    add("--skins", type=whole(0), default=0, metavar="N", help="seed of the sensors (%(default)s)")
    add(
        "--targets",
        type=whole(FEWEST_TARGETS, 48),
        metavar="N",
        help="targets of an indenter (8; toy: 2)",
    )
    add("--steps", type=whole(4), metavar="N", help="of a net from nothing (1000; toy: 16)")
    add(
        "--minutes",
        type=positive,
        default=2.5,
        metavar="N",
        help="the translator has 0.4 of this time (%(default)s)",
    )
    add("--gpus", metavar="N,...", help="GPU numbers, or `cpu` (all GPUs)")
    add("--per-gpu", type=whole(1), default=1, metavar="N", help="jobs on a GPU (%(default)s)")
    add("--processes", type=whole(1), metavar="N", help="processes of this command (all cores)")
    add("--only", type=listed, metavar="NAME,...", help="jobs, without those they need (all)")
    add("--stop-after", type=int, metavar="SECONDS", help="stop then; the same command goes on")
    add("--job", metavar="NAME", help="run one job in this process")


def run(options: argparse.Namespace) -> int:
    """Run all jobs that are not done; return 0, or 1 if one failed.

    Raises:
        LearningError: A seed or a job is unknown.
        SceneError: The folder is of other settings, or two sensors do not differ.
    """
    from benchmarks.learning.gauge_tables import coverage, jobs, page
    from benchmarks.learning.gauge_tables.skins import write_rows
    from benchmarks.learning.tables.on_gpus import Machine, _gpus, done_in, run_on
    from benchmarks.twin.command import stored

    if not all(seed.isdecimal() for seed in options.seeds):
        raise LearningError(f"--seeds: found {', '.join(options.seeds)}; allowed: numbers from 0")
    cores = options.processes or len(os.sched_getaffinity(0))
    study = _study(options, cores)
    if options.job is not None:
        covers = options.job.startswith("coverage ")
        (coverage.run_job if covers else jobs.run_job)(study, options.job)
        return 0
    out = options.out
    # Jobs of other sensors or sizes would pass for done.
    told = {name: getattr(options, name) for name in ("group", "size", "skins", "fit")}
    stored(out / "settings.jsonl", {**told, "targets": study.of.targets, "steps": study.of.steps})
    write_rows(out / "rows", options.group, study.designs, options.skins)
    gpus = options.gpus.split(",") if options.gpus else _gpus()[0]
    due = _tasks(options, study, cores, done_in(out))
    complete = run_on(due, Machine(gpus, options.per_gpu), out, options.stop_after)
    lines = page.write(study, [int(seed) for seed in options.seeds])
    print("\n".join(lines))
    return int(not complete)


def _study(options: argparse.Namespace, cores: int) -> Study:
    from dataclasses import replace

    import torch

    from benchmarks.learning.gauge_tables.jobs import SIZES, Study

    size = SIZES[options.size]
    device = torch.device("cpu")
    if options.job is not None and options.gpus != "cpu" and torch.cuda.is_available():
        device = torch.device("cuda")
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    given: dict[str, Any] = {name: getattr(options, name) for name in ("group", "skins", "fit")}
    return Study(
        options.out,
        size.chain,
        options.minutes,
        device,
        max(1, min(8, cores // 4)),
        of=replace(
            size,
            targets=options.targets or size.targets,
            steps=options.steps or size.steps,
        ),
        **given,
    )


def _tasks(options: argparse.Namespace, study: Study, cores: int, done: set[str]) -> list[Task]:
    from benchmarks.learning.gauge_tables.jobs import (
        archive_path,
        draws_path,
        further_path,
        names,
        twin_path,
    )
    from benchmarks.learning.gauge_tables.skins import GAUGE
    from benchmarks.learning.tables.on_gpus import Task
    from sim.sensors.sensor import read_sensor

    known = names(study, [int(seed) for seed in options.seeds])
    wanted = {*(options.only or known)}
    if unknown := wanted - {*known}:
        raise LearningError(f"--only: found {', '.join(unknown)}; allowed: {', '.join(known)}")
    wanted -= done
    on_cpu, size = options.gpus == "cpu", study.of
    threads = "2" if on_cpu else str(max(1, cores // 8))
    # A job that counts as one of a GPU runs alone without one; labels use cores only.
    found = []
    for name, needs in known.items():
        if name not in wanted:
            continue
        kind, *rest = name.split()
        gpu, one = 1, (("OMP_NUM_THREADS", threads),)
        if kind in ("archive", "draws", "further"):
            row = study.out / "rows" / f"{rest[0]}.yaml"
            trajectory = read_sensor(row).trajectory
            assert trajectory is not None
            command = ["-m", "tactile", "sim", "archive", "--no-check"]
            command += ["--steps", str(size.phase)]
            targets = FEWEST_TARGETS if kind == "further" else size.targets
            command += ["--scale", f"{targets / len(trajectory):.6f}"]
            shapes, tier = size.seen, study.fit
            if kind == "draws":
                twin = twin_path(study.out, f"{rest[0]}-draw")
                command += [str(twin), "--draws", str(size.draws)]
                command += ["--out", str(draws_path(study.out, rest[0]))]
            else:
                shapes, drawn, out = (*size.seen, *size.unseen), size.drawn, archive_path
                if kind == "further":
                    shapes, drawn, out = GAUGE[:1], drawn + sum(size.further), further_path
                tier = size.tier
                command += [str(row), "--drawn", str(drawn)]
                command += ["--out", str(out(study.out, rest[0]))]
            command += ["--indenters", ",".join(shapes), "--tier", tier]
            if on_cpu or tier == "layer":
                gpu, one = 0, (("OMP_NUM_THREADS", "1"),)
                command += ["--processes", str(max(1, cores // 2))]
            else:
                command += ["--device", "cuda:0", "--processes", str(max(1, cores // 12))]
        else:
            if kind in ("labels", "further-labels"):
                one = (("OMP_NUM_THREADS", "1"),)
            command = ["-m", "benchmarks", "gauge-tables", "--job", name, "--out", str(study.out)]
            command += ["--group", study.group, "--size", options.size]
            command += ["--skins", str(study.skins), "--fit", study.fit]
            command += ["--targets", str(size.targets)]
            command += ["--steps", str(size.steps)]
            command += ["--minutes", str(study.minutes), "--processes", str(cores)]
            command += ["--gpus", "cpu"] if on_cpu else []
        needed = tuple(each for each in needs if each in wanted)
        found.append(Task(name, (sys.executable, *command), needed, one, gpu))
    return found
