"""Compute all tables and ablations in parallel, on all available GPUs.

    python -m benchmarks learning-on-gpus OUT [--only NAME,...] [--gpus 0,1] [--jobs 8]

Does the work of run.sh and ablations.sh, starting each task as soon as its dependencies are done:
presses are simulated on the CPU cores, two archives at a time at low priority; each table and each
ablation takes a fraction of a GPU. The pages are written at the end; the time of each task goes to
OUT/times.csv and its output to OUT/log. If a task fails, only its dependents are skipped. After
Ctrl-C, the same command continues.
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

HERE = Path(__file__).parent
GROUPS = ("heterogeneous", "material", "homogeneous")
FULL = tuple(f"{group}-full" for group in ("material", "heterogeneous", "homogeneous"))
CLEAN = "heterogeneous-clean"
ABLATIONS = ("whole", "half", "quarter", "single-frame", "clean")
ABLATION = "ablation "
ARCHIVES_AT_ONCE = 2
# Maximum GPU memory of each model trained in parallel.
JOB_BYTES = 7 * 2**30
# Interval between checks of the running tasks [s].
LOOK_EVERY = 0.5
# Lines of a failed task's output to show.
SAID_LINES = 15


@dataclass(frozen=True)
class Task:
    """A task: a table, an ablation or an archive."""

    name: str
    command: tuple[str, ...]
    needs: tuple[str, ...] = ()
    """Names of the tasks that must be done before."""
    environment: tuple[tuple[str, str], ...] = ()
    """Additional environment variables."""
    jobs: int = 0
    """Number of models that it trains in parallel on a GPU; 0: it runs on the CPU cores."""

    def can_begin(self, done: Iterable[str]) -> bool:
        """Return True if all dependencies are done."""
        return {*self.needs} <= {*done}


@dataclass
class Running:
    """A running task."""

    task: Task
    gpu: int
    """Index of the GPU, from 0."""
    process: subprocess.Popen[bytes]
    since: float


@dataclass
class Machine:
    """Resources shared by the tasks."""

    gpus: Sequence[str]
    """CUDA device names."""
    room: int
    """Number of models that fit into a GPU's memory."""
    running: list[Running] = field(default_factory=list)

    def place_for(self, task: Task) -> int | None:
        """Return the GPU that trains the fewest models; None: no GPU has space."""

        def held(gpu: int) -> tuple[int, int]:
            jobs = [run.task.jobs for run in self.running if run.gpu == gpu]
            return sum(jobs), len(jobs)

        gpu = min(range(len(self.gpus)), key=held)
        if task.jobs == 0:
            archives = sum(run.task.jobs == 0 for run in self.running)
            return gpu if archives < ARCHIVES_AT_ONCE else None
        models, _ = held(gpu)
        return gpu if models == 0 or models + task.jobs <= self.room else None


def tasks(out: Path, jobs: int, cores: int) -> list[Task]:
    """Return all tasks, the most urgent first.

    Args:
        out: Folder for the tables.
        jobs: Models that a table trains in parallel; an ablation has fewer pairs and trains half.
        cores: Number of CPU cores.
    """

    def archive(name: str) -> Task:
        made = (("ONLY", "archive"), ("PROCESSES", str(max(1, cores // ARCHIVES_AT_ONCE))))
        return Task(f"archive {name}", ("bash", str(HERE / "run.sh"), str(out), name), (), made)

    def trained(name: str, script: str, needs: str, at_once: int) -> Task:
        command = ("bash", str(HERE / script), str(out), name.removeprefix(ABLATION))
        reported = (
            ("ONLY", "experiment"),  # all pages are written at the end
            ("JOBS", str(at_once)),
            ("PROCESSES", str(max(at_once, cores // 4))),
        )
        return Task(name, command, (needs,), reported, at_once)

    def table(name: str) -> Task:
        return trained(name, "run.sh", f"archive {name}", jobs)

    def ablation(name: str, needs: str) -> Task:
        return trained(ABLATION + name, "ablations.sh", needs, max(1, jobs // 2))

    return [
        *map(archive, (*GROUPS[:2], CLEAN, GROUPS[2], *FULL)),
        *map(table, GROUPS),
        # Trains its own translators; the others use those of the table.
        ablation("clean", f"archive {CLEAN}"),
        *map(table, FULL),
        *(ablation(name, GROUPS[0]) for name in ABLATIONS if name != "clean"),
    ]


def run_all(
    due: Iterable[Task], machine: Machine, out: Path, say: Callable[[str], None]
) -> dict[str, float]:
    """Run each task once its dependencies are done; return the seconds of those that succeeded.

    Args:
        due: Tasks, the most urgent first.
        machine: Resources shared by the tasks.
        out: Folder for logs and times.
        say: Called with a line for each start and end of a task.

    Raises:
        KeyboardInterrupt: The run was stopped; running tasks were signalled and have ended.
    """
    waiting, took, began = list(due), dict[str, float](), time.monotonic()
    (out / "log").mkdir(parents=True, exist_ok=True)

    def now() -> str:
        return f"{time.monotonic() - began:6.0f} s  "

    try:
        while waiting or machine.running:
            for task in [task for task in waiting if task.can_begin(took)]:
                gpu = machine.place_for(task)
                if gpu is not None:
                    waiting.remove(task)
                    machine.running.append(_start(task, gpu, machine, out))
                    say(f"{now()}{task.name}: begins, GPU {machine.gpus[gpu]}")
            ended = [run for run in machine.running if run.process.poll() is not None]
            for run in ended:
                machine.running.remove(run)
                seconds = time.monotonic() - run.since
                if run.process.returncode == 0:
                    took[run.task.name] = seconds
                    _write(out / "times.csv", took)
                    say(f"{now()}{run.task.name}: done in {seconds:.0f} s")
                    continue
                say(f"{now()}{run.task.name}: failed after {seconds:.0f} s, with this output:")
                reported = _log(out, run.task).read_text(errors="replace").splitlines()
                for line in reported[-SAID_LINES:]:
                    say(f"    {line}")
            if not machine.running and not any(task.can_begin(took) for task in waiting):
                for task in waiting:
                    say(f"{now()}{task.name}: skipped, it needs {', '.join(task.needs)}")
                break
            if not ended:
                time.sleep(LOOK_EVERY)
    except KeyboardInterrupt:
        for run in machine.running:  # a terminal signals them too, which is harmless
            run.process.send_signal(signal.SIGINT)
        for run in machine.running:
            run.process.wait()
        raise
    return took


def done_in(out: Path) -> set[str]:
    """Return the names of the tasks that `run_on` noted as done in a folder."""
    return {path.name.replace("+", " ") for path in (out / "done").glob("*")}


def run_on(due: Sequence[Task], machine: Machine, out: Path, stop_after: int | None) -> bool:
    """Run tasks as `run_all`, print and note each that is done; return True if all are.

    Args:
        due: Tasks, the most urgent first.
        machine: Resources shared by the tasks.
        out: Folder for logs, times and notes.
        stop_after: Time after which running tasks are stopped, as by Ctrl-C [s]; None: never.
    """
    done = out / "done"
    done.mkdir(parents=True, exist_ok=True)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if stop_after:
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.alarm(stop_after)

    def tell(line: str) -> None:
        print(line, flush=True)
        name, found, _ = line[10:].partition(": done in ")
        if found:
            (done / name.strip().replace(" ", "+")).touch()

    try:
        return len(run_all(due, machine, out, tell)) == len(due)
    except KeyboardInterrupt:
        print("stopped; the same command goes on", file=sys.stderr)
        return False
    finally:
        signal.alarm(0)


def _start(task: Task, gpu: int, machine: Machine, out: Path) -> Running:
    environment = os.environ | dict(task.environment)
    environment |= {"CUDA_VISIBLE_DEVICES": machine.gpus[gpu], "DEVICE": "cuda:0"}
    environment.setdefault("PYTHON", sys.executable)
    behind = () if task.jobs else ("nice", "-n", "10")
    with _log(out, task).open("wb") as log:
        process = subprocess.Popen(
            [*behind, *task.command], stdout=log, stderr=subprocess.STDOUT, env=environment
        )
    return Running(task, gpu, process, time.monotonic())


def _log(out: Path, task: Task) -> Path:
    return out / "log" / f"{task.name.replace(' ', '-')}.log"


def _write(path: Path, took: dict[str, float]) -> None:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("piece", "seconds"), *took.items()])


def _gpus() -> tuple[list[str], int]:
    """Return the GPUs of this machine by number, and the memory of the smallest [B]."""
    asked = ["nvidia-smi", "--query-gpu=index,memory.total", "--format=csv,noheader,nounits"]
    try:
        reported = subprocess.run(asked, check=True, capture_output=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError):
        sys.exit("no GPU: nvidia-smi does not answer; run.sh makes tables on a CPU, in days")
    found = [line.split(", ") for line in reported.splitlines()]
    return [index for index, _ in found], min(int(mebibytes) for _, mebibytes in found) * 2**20


def _page(out: Path, page: str, made: Sequence[Path], *options: str) -> None:
    if made:
        learning = [os.environ.get("PYTHON", sys.executable), "-m", "benchmarks", "learning-tables"]
        subprocess.run([*learning, *map(str, made), "--out", str(out / page), *options], check=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.description = __doc__.split("\n\n")[0]
    parser.add_argument("out", type=Path, help="output folder")
    parser.add_argument(
        "--only", help="tables and ablations, which run with their dependencies (all)"
    )
    parser.add_argument("--gpus", help="GPU numbers, e.g. 0,1 (all)")
    parser.add_argument("--jobs", type=int, default=8, help="models trained in parallel per table")


def run(options: argparse.Namespace) -> int:
    """Run the requested tasks; return 0, or 1 if a task failed."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    gpus, memory = _gpus()
    gpus = options.gpus.split(",") if options.gpus else gpus
    cores = len(os.sched_getaffinity(0))
    due = chosen(tasks(options.out, options.jobs, cores), options.only)
    machine = Machine(gpus, memory // JOB_BYTES)
    took = run_all(due, machine, options.out, lambda line: print(line, flush=True))
    tables = [options.out / name for name in (*GROUPS, *FULL) if name in took]
    _page(options.out, "learning-tables.md", tables, "--intro", str(HERE / "tables.md"))
    made = [options.out / "ablations" / name for name in ABLATIONS if ABLATION + name in took]
    _page(options.out, "learning-ablations.md", made, "--intro", str(HERE / "ablations.md"))
    return int(len(took) < len(due))


def chosen(known: Sequence[Task], only: str | None) -> list[Task]:
    """Return the named tasks and all their dependencies; None: all tasks."""
    if only is None:
        return list(known)
    by_name = {task.name: task for task in known}
    named = [ABLATION + name if name in ABLATIONS else name for name in only.split(",")]
    wrong = [name for name in named if name not in by_name]
    if wrong:
        sys.exit(f"--only: found {', '.join(wrong)}; allowed: {', '.join(by_name)}")
    kept: set[str] = set()
    while named:
        kept.add(name := named.pop())
        named += by_name[name].needs
    return [task for task in known if task.name in kept]
