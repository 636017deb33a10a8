"""The work of an experiment, in pieces that need nothing of each other: many can run at once.

A piece for each translator, one for compensation, and one for each sensor: its own force model, and
what that says of its own frames and of others'. When what it needs of these is done, a piece for
each source and translator: models that learn from translated frames, and scores of translations.
Whatever is there already is not made again.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence, Set
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass, field
from pathlib import Path

import torch

from learning.compensation import read_stored
from learning.data.splits import read_split
from learning.errors import LearningError
from learning.evaluation.distribution import MarkerGrid
from learning.evaluation.predictions import Predictions
from learning.evaluation.translation import TranslationScores, read_scores, score_translation
from learning.experiment.forces import Forces
from learning.experiment.models import Places, open_translator, run_command, train_translator
from learning.experiment.parts import TESTED, Pair, thinned
from learning.experiment.settings import ExperimentSettings
from learning.progress import Progress
from learning.translation import archive as translated
from learning.translation.archive import Model
from recorder import MarkerArchive
from recorder.processes import Workers

# A method of a worker and its arguments.
Piece = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Done:
    """What a piece of work gives."""

    predictions: list[Predictions] = field(default_factory=list)
    scores: list[TranslationScores] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Work:
    """What all pieces have in common."""

    archive: Path
    """Frames of all sensors, with labels."""
    out: Path
    """Folder of the experiment, in which the split is."""
    settings: ExperimentSettings
    """Which models, on how much data."""
    pairs: tuple[Pair, ...]
    """From which sensors to which."""
    device: str
    """Where models are trained and frames are translated."""
    processes: int
    """How many follow markers, of each piece."""

    @property
    def pieces(self) -> dict[Piece, frozenset[Piece]]:
        """All pieces, the longest to begin with, and which others each needs to be done before."""
        sources = tuple(dict.fromkeys(pair.source for pair in self.pairs))
        sensors = dict.fromkeys([*sources, *(pair.target for pair in self.pairs)])
        trained: list[Piece] = [("train", name) for name in self.settings.translators]
        fitted: list[Piece] = [("compensate",)] if self.settings.compensation else []
        alone = [*trained, *fitted, *(("own", sensor) for sensor in sensors)]
        return {piece: frozenset() for piece in alone} | {
            ("carried", source, name): frozenset([("train", name), *fitted, ("own", source)])
            for source in sources
            for name in self.settings.translators
        }


class Worker:
    """Does pieces of work; keeps what several of them read."""

    def __init__(self, work: Work, say: Callable[[str], None]) -> None:
        """Open the archive and the split.

        Raises:
            LearningError: A split that cannot be read.
            SessionError: A damaged archive.
        """
        self._work, self._say = work, say
        self._device = torch.device(work.device)
        self._places = Places(work.out, work.archive)
        self._archive, self._split = MarkerArchive(work.archive), read_split(self._places.split)
        self._forces = Forces(
            self._archive,
            self._split,
            work.settings,
            self._places,
            self._device,
            work.processes,
            say,
        )

    def do(self, piece: Piece) -> Done:
        """Return what a piece of work gives.

        Raises:
            LearningError: Presses without labels, a training that was refused or diverged.
            SessionError: A damaged archive.
            KeyboardInterrupt: It was stopped between two steps of a training.
        """
        name, *arguments = piece
        done: Done = getattr(self, name)(*arguments)
        return done

    def train(self, name: str) -> Done:
        """Train a translator, where it has to be."""
        train_translator(self._places, self._work.settings, name, self._device, self._say)
        return Done()

    def compensate(self) -> Done:
        """Fit priors of skins, and choose how labels of the pairs are brought over."""
        places, pairs = self._places, self._work.pairs
        if not places.compensation.exists():
            asked = ",".join(f"{pair.source}:{pair.target}" for pair in pairs)
            command = ["compensate", str(places.archive), "--out", str(places.compensation)]
            run_command([*command, "--pairs", asked, "--split", str(places.split)], self._say)
        return Done()

    def own(self, sensor: str) -> Done:
        """Train a sensor's own model; predict it, and all that it is carried over to."""
        pairs = [pair for pair in self._work.pairs if pair.source == sensor]
        found = [self._forces.untranslated(pair) for pair in pairs]
        if any(pair.target == sensor for pair in self._work.pairs):
            found.append(self._forces.own(sensor))
        return Done(found)

    def carried(self, source: str, name: str) -> Done:
        """Train models on a source's translated frames; predict their targets, score the frames."""
        model = open_translator(self._places, self._work.settings, name, self._device)
        pairs = [pair for pair in self._work.pairs if pair.source == source]
        stored = self._places.compensation
        labels = read_stored(stored) if self._work.settings.compensation else None
        found = self._forces.carried_over(pairs, name, model, labels)
        return Done(found, self._scores(source, pairs, name, model))

    def _scores(
        self, source: str, pairs: Sequence[Pair], name: str, model: Model
    ) -> list[TranslationScores]:
        """Translate some tested presses into an archive, and score its sensors."""
        settings = self._work.settings
        if not settings.scored_presses:
            return []
        few = thinned(self._split, settings.scored_presses, settings.seed)
        roles = [role for role in TESTED if len(few.locations(role))]
        path = self._places.translated(source, name)
        progress = Progress(f"frames of {source} by {name}", sys.stderr)
        try:
            translated.translate_archive(
                self._archive,
                path,
                [translated.Pair(pair.source, pair.target) for pair in pairs],
                model,
                split=few,
                roles=roles,
                progress=progress,
            )
        finally:
            progress.close()
        scores = []
        for sensor in MarkerArchive(path).values():
            file = self._places.predictions / f"{sensor.name}.{name}.scores.npz"
            if not file.exists():
                score_translation(
                    self._archive, sensor, few, roles, MarkerGrid(), seed=settings.seed
                ).write(file)
            scores.append(read_scores(file))
        self._say(f"translations of {source} by {name} scored: {path}")
        return scores


# Pieces of an experiment, one after the other or several at once.
#
# A small network keeps a GPU busy for a part of the time only: the rest goes into telling it what
# to do. Several processes fill it.

Say = Callable[[str], None]


def do_all(work: Work, jobs: int, say: Say) -> list[Done]:
    """Return what all pieces give, each done after those that it needs.

    Args:
        work: What is to be done.
        jobs: How many pieces at once, each in a process of its own; 1: all in this one.
        say: Called with a line for each thing that was done.

    Raises:
        LearningError: A piece that cannot be done, or for which there is no memory beside the
            others; pieces that run meanwhile end first.
        SessionError: A damaged archive.
        WorkerLost: A process was killed, by a lack of memory for example.
        KeyboardInterrupt: It was stopped; what trains saves where it is.
    """
    if jobs == 1:
        worker = Worker(work, say)
        return [worker.do(piece) for piece in work.pieces]
    with Workers(jobs, _begin, work, patient=True, fewer="fewer jobs") as workers:
        return _done(workers, work.pieces, say)


# Of a process of the pool.
_worker: Worker | None = None
# Lines since the last piece was done.
_said: list[str] = []
# Ctrl-C came: pieces that this process was already given are not begun.
_stopped = False


def _begin(work: Work) -> None:
    global _worker
    _worker = Worker(work, _said.append)


def _do(piece: Piece) -> tuple[Done, list[str]]:
    global _stopped
    if _worker is None:
        raise RuntimeError("the pool has not begun")
    if _stopped:
        raise KeyboardInterrupt
    _said.clear()
    try:
        done = _worker.do(piece)
    except KeyboardInterrupt:
        _stopped = True
        raise
    except torch.OutOfMemoryError as error:
        raise LearningError(
            f"jobs: found no memory left on the device for {' '.join(piece)} beside the others; "
            "allowed: fewer jobs (the same command goes on)"
        ) from error
    return done, [*_said]


def _done(pool: Workers | Executor, pieces: Mapping[Piece, Set[Piece]], say: Say) -> list[Done]:
    """Return what pieces give, in their order; each begins when all it needs is done."""
    due, found = dict(pieces), dict[Piece, Done]()
    running: dict[Future[tuple[Done, list[str]]], Piece] = {}
    while due or running:
        for piece in [piece for piece, needed in due.items() if needed <= found.keys()]:
            del due[piece]
            running[pool.submit(_do, piece)] = piece
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            done, said = future.result()
            for line in said:
                say(line)
            found[running.pop(future)] = done
    return [found[piece] for piece in pieces]
