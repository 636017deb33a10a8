"""Run of an experiment: split, translators, force models, compensation, predictions, report.

Existing results are reused: an interrupted experiment continues where it stopped.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import replace

import numpy as np
import torch

from learning.config import require_same, settings_to_dict
from learning.data.splits import make_split, read_split
from learning.errors import LearningError
from learning.evaluation.predictions import UNSEEN, ForceRow, after
from learning.evaluation.report import Report, write_report
from learning.experiment.frames import labelled_sensors, pairs_of
from learning.experiment.settings import ExperimentSettings
from learning.experiment.stages import (
    BEFORE,
    TRANSFERRED,
    Experiment,
    Places,
    Task,
    TaskResult,
    check_settings,
)
from recorder.archive import MarkerArchive, archive_fingerprint
from recorder.processes import Workers

Say = Callable[[str], None]


def run_experiment(
    places: Places,
    settings: ExperimentSettings,
    *,
    pairs: Sequence[str] | None = None,
    device: str = "cpu",
    processes: int = 1,
    jobs: int = 1,
    say: Say = print,
    where: str = "settings",
) -> Report:
    """Run or continue an experiment and return its report.

    Its archive has frames of all sensors, labels and force-depth presses. `pairs` are
    `SOURCE:TARGET`, by default all directed ones; `jobs` tasks run at once, each in its own process
    if there are several, `processes` track markers. `say` is called with a line for each completed
    part; `where` is the place of the settings in errors.
    """
    if jobs < 1:
        raise LearningError(f"--jobs: found {jobs}; allowed: 1 or more")
    archive = MarkerArchive(places.archive)
    if archive.warning:
        raise LearningError(archive.warning)
    experiment = Experiment(
        places, settings, pairs_of(archive, pairs), device, max(1, processes // jobs), say=say
    )
    try:
        check_settings(settings, device)
    except LearningError as error:
        raise LearningError(f"{where}.{error}") from None
    _begin(experiment, archive)
    labelled = labelled_sensors(archive, experiment.split)
    unlabelled = dict.fromkeys(p.target for p in experiment.pairs if p.target not in labelled)
    experiment.unlabelled = frozenset(unlabelled)
    for name in unlabelled:
        say(
            f"{name}: no labels in training presses, so no model is trained on its own labels "
            "(target) and none compensates by them (oracle)"
        )
    done = do_all(experiment, jobs)
    return write_report(
        [predictions for each in done for predictions in each.predictions],
        [scores for each in done for scores in each.scores],
        places.report,
        title=settings.description,
    )


def gained(rows: Sequence[ForceRow]) -> str:
    """Return R2 on unseen indenters before and after, means over pairs, axes and translators.

    "After" is the last method that needs no label of the target.
    """
    if not rows:
        return "no labels to compare with"
    unseen = [row for row in rows if row.role == UNSEEN]
    reported = []
    for name, method in ((BEFORE, BEFORE), (TRANSFERRED, after({row.method for row in unseen}))):
        some = [row.errors for row in unseen if row.method == method]
        mean = f"{np.mean([one.r2_mean for one in some]):.3f}" if some else "unknown"
        reported.append(f"{name} R2 {mean}{''.join(dict.fromkeys(one.of_axes for one in some))}")
    return "  ".join(reported)


def _begin(experiment: Experiment, archive: MarkerArchive) -> None:
    """Write definition and split of the experiment, or check that existing ones are the same."""
    paths, settings = experiment.places, experiment.settings
    content = {
        "archive": archive_fingerprint(archive),
        "pairs": [f"{pair.source}:{pair.target}" for pair in experiment.pairs],
        **settings_to_dict(settings),
    }
    paths.predictions.mkdir(parents=True, exist_ok=True)
    require_same(paths.out / "experiment.json", content)
    if paths.split.exists():
        read_split(paths.split).check(archive)
        return
    make_split(
        archive, validation=settings.validation, new_press=settings.new_press, seed=settings.seed
    ).write(paths.split)


# Execution of the tasks, sequentially or in parallel.
#
# A small network keeps a GPU busy only part of the time; the rest is spent on launching its
# kernels. Several processes fill the gaps.


def do_all(experiment: Experiment, jobs: int) -> list[TaskResult]:
    """Execute all tasks, each after those that it depends on, and return their results."""
    if jobs == 1:
        return [experiment.do(task) for task in experiment.tasks]
    # A copy has none of the cached data, which each process reads for itself.
    alike = replace(experiment, say=print)
    with Workers(jobs, _begin_worker, alike, patient=True, fewer="fewer jobs") as workers:
        return _results_of(workers, experiment.tasks, experiment.say)


# The experiment in a process of the pool.
_experiment: Experiment | None = None
# Lines since the last task was done.
_said: list[str] = []
# Set by Ctrl-C: tasks already assigned to this process are not begun.
_stopped = False


def _begin_worker(experiment: Experiment) -> None:
    global _experiment
    _experiment = replace(experiment, say=_said.append)


def _do(task: Task) -> tuple[TaskResult, list[str]]:
    global _stopped
    if _experiment is None:
        raise RuntimeError("the pool has not begun")
    if _stopped:
        raise KeyboardInterrupt
    _said.clear()
    try:
        done = _experiment.do(task)
    except KeyboardInterrupt:
        _stopped = True
        raise
    except torch.OutOfMemoryError as error:
        raise LearningError(
            f"jobs: found no memory left on the device for {' '.join(task)} beside the others; "
            "allowed: fewer jobs (repeat the command to continue)"
        ) from error
    return done, [*_said]


def _results_of(
    pool: Workers | Executor, tasks: Mapping[Task, Set[Task]], say: Say
) -> list[TaskResult]:
    """Return results of tasks in order; each task starts when its dependencies are done."""
    due, results = dict(tasks), dict[Task, TaskResult]()
    running: dict[Future[tuple[TaskResult, list[str]]], Task] = {}
    while due or running:
        for task in [task for task, needed in due.items() if needed <= results.keys()]:
            del due[task]
            running[pool.submit(_do, task)] = task
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            done, reported = future.result()
            for line in reported:
                say(line)
            results[running.pop(future)] = done
    return [results[task] for task in tasks]
