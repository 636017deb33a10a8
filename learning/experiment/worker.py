"""Tasks of an experiment, many of which can run in parallel.

There is a task for each translator, one for compensation, and one for each sensor: its force model,
and predictions on its own frames and on others'. When the tasks that it depends on are done, a task
for each source and translator follows: models fine-tuned on translated frames, and scores of
translations. Existing results are reused.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence, Set
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, field
from pathlib import Path

import torch

from learning.compensation import CHOICE_OF_METHOD, SIMULATED, read_stored, twin_forces
from learning.compensation.fit import Curves, gather_priors, write_compensation
from learning.data.splits import read_split
from learning.errors import LearningError
from learning.evaluation.distribution import MARKER_GRID
from learning.evaluation.predictions import Predictions
from learning.evaluation.translation import TranslationScores, read_scores, score_translation
from learning.experiment.forces import Forces
from learning.experiment.models import Places, open_translator, train_translator
from learning.experiment.parts import TESTED, Pair, thinned
from learning.experiment.settings import ExperimentSettings
from learning.translation import archive as translated
from learning.translation.archive import Model
from recorder import MarkerArchive
from recorder.processes import Workers
from recorder.progress import ItemProgress

# Name of a method of `Worker` and its arguments.
Task = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class TaskResult:
    """Result of a task."""

    predictions: list[Predictions] = field(default_factory=list)
    scores: list[TranslationScores] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Job:
    """Inputs common to all tasks."""

    archive: Path
    """Frames of all sensors, with labels."""
    out: Path
    """Folder of the experiment, in which the split is."""
    settings: ExperimentSettings
    """Settings of models and amount of data."""
    pairs: tuple[Pair, ...]
    """Source and target sensors."""
    device: str
    """Device of training and translation."""
    processes: int
    """Number of processes that track markers, per task."""
    unlabelled: frozenset[str] = frozenset()
    """Targets without labels in training presses: no model is trained on their labels."""

    @property
    def tasks(self) -> dict[Task, frozenset[Task]]:
        """All tasks, the longest first, and the tasks that each depends on."""
        sources = tuple(dict.fromkeys(pair.source for pair in self.pairs))
        sensors = dict.fromkeys([*sources, *(pair.target for pair in self.pairs)])
        trained: list[Task] = [("train", name) for name in self.settings.translators]
        fitted: list[Task] = [("compensate",)] if _by_formulae(self.settings) else []
        alone = [
            *trained,
            *fitted,
            *(("own", sensor) for sensor in sensors if sensor not in self.unlabelled),
        ]
        return {task: frozenset() for task in alone} | {
            ("translated", source, name): frozenset([("train", name), *fitted, ("own", source)])
            for source in sources
            for name in self.settings.translators
        }


class Worker:
    """Executes tasks; caches data that several of them read."""

    def __init__(self, work: Job, say: Callable[[str], None]) -> None:
        """Open the archive and the split."""
        self._work, self._say = work, say
        self._device = torch.device(work.device)
        self._places = Places(work.out, work.archive)
        self._archive, self._split = MarkerArchive(work.archive), read_split(self._places.split)
        if SIMULATED in work.settings.compensation:
            for name in {name for pair in work.pairs for name in (pair.source, pair.target)}:
                twin_forces(self._archive[name])
        self._forces = Forces(
            self._archive,
            self._split,
            work.settings,
            self._places,
            self._device,
            work.processes,
            say,
            work.unlabelled,
        )

    def do(self, task: Task) -> TaskResult:
        """Execute a task and return its result."""
        name, *arguments = task
        done: TaskResult = getattr(self, name)(*arguments)
        return done

    def train(self, name: str) -> TaskResult:
        """Train a translator, if it needs training."""
        train_translator(
            self._archive, self._split, self._places, self._work.settings, name, self._device
        )
        return TaskResult()

    def compensate(self) -> TaskResult:
        """Fit priors of skins, and choose the compensation of each pair."""
        places = self._places
        if not places.compensation.exists():
            pairs = self._with_priors()
            if not pairs:
                return TaskResult()
            ends = [(pair.source, pair.target) for pair in pairs]
            lines = write_compensation(
                self._archive, places.compensation, pairs=ends, split=places.split
            )
            self._say("\n".join(lines))
        return TaskResult()

    def _with_priors(self) -> list[Pair]:
        """Return the pairs to compensate: an unlabelled target may have no force-depth curve."""
        missing = self._work.unlabelled
        if missing:
            missing = missing & frozenset(gather_priors(self._archive, Curves()).without)
        for name in sorted(missing):
            self._say(f"{name}: no force-depth curve, so labels are not compensated for it")
        return [pair for pair in self._work.pairs if pair.target not in missing]

    def own(self, sensor: str) -> TaskResult:
        """Train a sensor's own model; predict its own forces and those of its targets."""
        pairs = [pair for pair in self._work.pairs if pair.source == sensor]
        found = [self._forces.untranslated(pair) for pair in pairs]
        if any(pair.target == sensor for pair in self._work.pairs):
            found.append(self._forces.own(sensor))
        return TaskResult(found)

    def translated(self, source: str, name: str) -> TaskResult:
        """Fine-tune models on a source's translated frames; predict targets, score translations."""
        model = open_translator(self._places, name, self._device)
        pairs = [pair for pair in self._work.pairs if pair.source == source]
        stored = self._places.compensation
        asked = _by_formulae(self._work.settings) and stored.exists()
        labels = read_stored(stored) if asked else None
        found = self._forces.translated(pairs, name, model, labels)
        return TaskResult(found, self._scores(source, pairs, name, model))

    def _scores(
        self, source: str, pairs: Sequence[Pair], name: str, model: Model
    ) -> list[TranslationScores]:
        """Translate some test presses into an archive, and score its sensors."""
        settings = self._work.settings
        if not settings.scored_presses:
            return []
        few = thinned(self._split, settings.scored_presses, settings.seed)
        roles = [role for role in TESTED if len(few.locations(role))]
        path = self._places.translated(source, name)
        with ItemProgress(f"frames of {source} by {name}", sys.stderr) as progress:
            translated.translate_archive(
                self._archive,
                path,
                [translated.Pair(pair.source, pair.target) for pair in pairs],
                model,
                split=few,
                roles=roles,
                progress=progress,
            )
        scores = []
        for sensor in MarkerArchive(path).values():
            file = self._places.predictions / f"{sensor.name}.{name}.scores.npz"
            if not file.exists():
                score_translation(
                    self._archive, sensor, few, roles, MARKER_GRID, seed=settings.seed
                ).write(file)
            scores.append(read_scores(file))
        self._say(f"translations of {source} by {name} scored: {path}")
        return scores


def _by_formulae(settings: ExperimentSettings) -> bool:
    """Return True if labels are compensated by the paper's formulae."""
    return bool(CHOICE_OF_METHOD.keys() & set(settings.compensation))


# Execution of the tasks, sequentially or in parallel.
#
# A small network keeps a GPU busy only part of the time; the rest is spent on launching its
# kernels. Several processes fill the gaps.

Say = Callable[[str], None]


def do_all(work: Job, jobs: int, say: Say) -> list[TaskResult]:
    """Execute all tasks, each after those that it depends on, and return their results.

    Args:
        work: Inputs of the experiment.
        jobs: Number of tasks at once, each in its own process; 1: all in this process.
        say: Called with a line for each completed part.
    """
    if jobs == 1:
        worker = Worker(work, say)
        return [worker.do(task) for task in work.tasks]
    with Workers(jobs, _begin, work, patient=True, fewer="fewer jobs") as workers:
        return _done(workers, work.tasks, say)


# State of a process of the pool.
_worker: Worker | None = None
# Lines since the last task was done.
_said: list[str] = []
# Set by Ctrl-C: tasks already assigned to this process are not begun.
_stopped = False


def _begin(work: Job) -> None:
    global _worker
    _worker = Worker(work, _said.append)


def _do(task: Task) -> tuple[TaskResult, list[str]]:
    global _stopped
    if _worker is None:
        raise RuntimeError("the pool has not begun")
    if _stopped:
        raise KeyboardInterrupt
    _said.clear()
    try:
        done = _worker.do(task)
    except KeyboardInterrupt:
        _stopped = True
        raise
    except torch.OutOfMemoryError as error:
        raise LearningError(
            f"jobs: found no memory left on the device for {' '.join(task)} beside the others; "
            "allowed: fewer jobs (repeat the command to continue)"
        ) from error
    return done, [*_said]


def _done(pool: Workers | Executor, tasks: Mapping[Task, Set[Task]], say: Say) -> list[TaskResult]:
    """Return results of tasks in order; each task starts when its dependencies are done."""
    due, found = dict(tasks), dict[Task, TaskResult]()
    running: dict[Future[tuple[TaskResult, list[str]]], Task] = {}
    while due or running:
        for task in [task for task, needed in due.items() if needed <= found.keys()]:
            del due[task]
            running[pool.submit(_do, task)] = task
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            done, reported = future.result()
            for line in reported:
                say(line)
            found[running.pop(future)] = done
    return [found[task] for task in tasks]
