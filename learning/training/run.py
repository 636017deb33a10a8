"""Infrastructure of a training: run folder, devices, stateless random choices, Ctrl-C.

The folder holds the state of the run, its metrics and, in the end, its model:

    config.yaml                     kind, settings, data, code version
    metrics.jsonl                   values passed to `log`
    checkpoints/00001000/           model.safetensors, training.pt, config.yaml
    model.safetensors               written last: the folder is a finished model

A checkpoint is written under a temporary name and renamed, so that only complete ones exist. The
last few and the best are kept. A run resumes from its newest checkpoint; later lines are removed
from the log.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import math
import os
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from learning.config import settings_to_dict
from learning.errors import LearningError
from learning.training.checkpoint import (
    CONFIG,
    MODEL,
    UNREADABLE,
    Config,
    code_version,
    load_weights,
    read_config,
    save_weights,
)
from recorder.progress import ItemProgress, ReportItems
from recorder.settings import differing_keys
from recorder.store import replace_file, sync_directory

if TYPE_CHECKING:
    from accelerate import Accelerator


METRICS, CHECKPOINTS, TRAINING = "metrics.jsonl", "checkpoints", "training.pt"

_WRITING, _REPLACED = ".writing-", ".replaced-"
_RNG = "torch_rng"


class RunFolder:
    """The folder of a training, made by `open`."""

    def __init__(self, path: Path, config: Config, *, writes: bool = True) -> None:
        """Represent a folder that `open` has prepared."""
        self.path, self.config, self.writes = path, config, writes

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        kind: str,
        settings: Any,
        data_fingerprint: str,
        *,
        metadata: Mapping[str, Any] | None = None,
        writes: bool = True,
    ) -> Self:
        """Begin or resume a run; other settings or data than it was begun with are refused.

        `data_fingerprint` includes the split; `metadata` are plain values known before training
        that are needed to use the model. Of several processes only the main one `writes`.
        """
        folder = Path(path)
        config = Config(
            kind, settings_to_dict(settings), data_fingerprint, code_version(), dict(metadata or {})
        )
        run = cls(folder, config, writes=writes)
        if not writes:
            return run
        if (folder / CONFIG).exists():
            _require_same(folder, config)
            run._forget_later()
        elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise LearningError(f"{folder}: holds something else; allowed: a new or empty folder")
        else:
            folder.mkdir(parents=True, exist_ok=True)
            config.write(folder)
        return run

    @classmethod
    def nowhere(cls) -> Self:
        """Return a folder without files, which keeps nothing, for a training in memory."""
        return cls(Path(os.devnull), Config("", {}, "", ""), writes=False)

    @property
    def finished(self) -> bool:
        """True if the model is written."""
        return (self.path / f"{MODEL}.safetensors").is_file()

    def log(self, step: int, values: Mapping[str, float | str]) -> None:
        """Add values by name (`train/loss`) to the log; not finite ones are stored as null."""
        if not self.writes:
            return
        plain = {name: _plain(value) for name, value in values.items()}
        with (self.path / METRICS).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": step, **plain}) + "\n")

    def save(
        self,
        step: int,
        models: Mapping[str, nn.Module | Mapping[str, Tensor]],
        training: Mapping[str, Any],
        *,
        score: float | None = None,
    ) -> Path:
        """Write a checkpoint, then delete all but the two newest and the best.

        `models` are networks by name, not wrapped by Accelerate; `model` is the one to use.
        `training` is other state needed to resume, by name: objects with a `state_dict`, such as
        optimisers; torch's generators are saved as well. A lower validation score is better.
        """
        folder = self.path / CHECKPOINTS / f"{step:08d}"
        if not self.writes:
            return folder
        building = folder.with_name(_WRITING + folder.name)
        shutil.rmtree(building, ignore_errors=True)
        building.mkdir(parents=True)
        for name, model in models.items():
            save_weights(model, building / f"{name}.safetensors")
        states = {name: value.state_dict() for name, value in training.items()}
        states[_RNG] = {"cpu": torch.get_rng_state()}
        if torch.cuda.is_available():
            states[_RNG]["cuda"] = torch.cuda.get_rng_state()
        torch.save(states, building / TRAINING)
        _read_training(building / TRAINING)
        replace(self.config, step=step, score=score).write(building)
        for file in building.iterdir():
            sync_directory(file)
        sync_directory(building)
        if folder.exists():
            folder.rename(folder.with_name(_REPLACED + folder.name))
        building.rename(folder)
        sync_directory(folder.parent)
        self._prune()
        return folder

    def latest(self) -> Path | None:
        """Return the newest checkpoint, or None."""
        checkpoints = self._checkpoints()
        return checkpoints[-1] if checkpoints else None

    def best(self) -> Path | None:
        """Return the checkpoint with the lowest score, the older if equal; None if unscored."""
        scored = [(read_config(path).score, path) for path in self._checkpoints()]
        with_score = [(score, path) for score, path in scored if score is not None]
        return min(with_score)[1] if with_score else None

    def restore(
        self, models: Mapping[str, nn.Module], training: Mapping[str, Any] | None = None
    ) -> int:
        """Load the newest checkpoint into networks and optimisers; return the number of steps done.

        That is 0 without a checkpoint; nothing changes then. Names are those of `save`.
        """
        folder = self.latest()
        if folder is None:
            return 0
        for name, model in models.items():
            load_weights(model, folder / f"{name}.safetensors")
        states = _read_training(folder / TRAINING)
        for name, value in (training or {}).items():
            if name not in states:
                raise LearningError(f"{folder / TRAINING}: found no {name!r}")
            try:
                value.load_state_dict(states[name])
            except (ValueError, KeyError, RuntimeError) as error:
                raise LearningError(f"{folder / TRAINING}.{name}: does not fit: {error}") from error
        torch.set_rng_state(states[_RNG]["cpu"])
        if "cuda" in states[_RNG] and torch.cuda.is_available():
            torch.cuda.set_rng_state(states[_RNG]["cuda"])
        step = read_config(folder).step
        if step is None:
            raise LearningError(f"{folder / CONFIG}.step: missing; allowed: a number of steps")
        return step

    def finish(
        self,
        step: int,
        models: Mapping[str, nn.Module | Mapping[str, Tensor]],
        *,
        score: float | None = None,
    ) -> None:
        """Write networks by name; `model` marks the run as finished."""
        if not self.writes:
            return
        self.config = replace(self.config, step=step, score=score)
        self.config.write(self.path)
        # `model` is written last, as it marks the run as finished.
        for name in sorted(models, key=lambda name: name == MODEL):
            save_weights(models[name], self.path / f"{name}.safetensors")

    def _checkpoints(self) -> list[Path]:
        """Return complete checkpoints, oldest first."""
        folder = self.path / CHECKPOINTS
        numbered = [path for path in folder.glob("*") if path.name.isdecimal()]
        return sorted(path for path in numbered if (path / CONFIG).is_file())

    def _prune(self) -> None:
        retained = {*self._checkpoints()[-2:], self.best()}
        for path in self._checkpoints():
            if path not in retained:
                shutil.rmtree(path)
        for name in (_WRITING, _REPLACED):
            for left in (self.path / CHECKPOINTS).glob(f"{name}*"):
                shutil.rmtree(left)

    def _forget_later(self) -> None:
        """Remove truncated lines, and lines after the newest checkpoint, from the log."""
        log = self.path / METRICS
        if self.finished or not log.exists():
            return
        newest = self.latest()
        last = 0 if newest is None else int(newest.name)
        lines = [line for line in log.read_text(encoding="utf-8").splitlines() if _upto(line, last)]
        replace_file(log, "".join(f"{line}\n" for line in lines).encode())


def _require_same(folder: Path, config: Config) -> None:
    there = read_config(folder)
    one, other = (
        {"kind": each.kind, "settings": {**each.settings, "description": None}, "data": each.data}
        for each in (there, config)
    )
    different = differing_keys(one, other)
    if different:
        raise LearningError(
            f"{folder}: was begun with other {', '.join(different)}; allowed: the same ones, or "
            "another folder"
        )


def _upto(line: str, last: int) -> bool:
    try:
        return bool(json.loads(line)["step"] <= last)
    except (json.JSONDecodeError, KeyError, TypeError):
        return False


def _plain(value: float | str) -> float | str | None:
    if isinstance(value, str | int):
        return value
    number = float(value)
    return number if math.isfinite(number) else None


def _read_training(path: Path) -> dict[str, Any]:
    try:
        states: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except UNREADABLE as error:
        raise LearningError(f"{path}: damaged, or not plain states: {error}") from error
    return states


# Devices of a training: one process, or the number that `torchrun` starts.
#
# tactile train force ...                              # one GPU, or the CPU
# torchrun --nproc-per-node 4 -m tactile train force ...         # four GPUs of one host

Precision = Literal["no", "bf16", "fp16"]


@dataclass(frozen=True, slots=True)
class LaunchSettings:
    """Device and precision of a training."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto` selects a GPU if there is one."""
    mixed_precision: Precision = "no"
    """Precision in which networks are evaluated; weights stay float32."""


def accelerator(settings: LaunchSettings) -> Accelerator:
    """Return the Accelerator for the requested device and precision."""
    from accelerate import Accelerator
    from accelerate.state import AcceleratorState, PartialState

    cuda = torch.cuda.is_available()
    if settings.device == "cuda" and not cuda:
        raise LearningError("device: found cuda, and this machine has none; allowed: auto, cpu")
    on_cpu = settings.device == "cpu" or not cuda
    if settings.mixed_precision == "fp16" and on_cpu:
        raise LearningError("mixed_precision: found fp16 on a CPU; allowed: no, bf16")
    if settings.mixed_precision == "bf16" and not on_cpu and not torch.cuda.is_bf16_supported():
        name = torch.cuda.get_device_name()
        raise LearningError(f"mixed_precision: found bf16 on {name}; allowed: no, fp16")
    if PartialState._shared_state and PartialState().num_processes == 1:
        # Accelerate keeps the options of the first training in a process; this one may differ.
        AcceleratorState._reset_state(reset_partial_state=True)
    return Accelerator(cpu=on_cpu, mixed_precision=settings.mixed_precision)


def described(launched: Accelerator) -> str:
    """Return a one-line description of device and precision."""
    device = launched.device
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    threads = "" if device.type == "cuda" else f", {torch.get_num_threads()} threads"
    count = launched.num_processes
    processes = f"{count} processes, " if count > 1 else ""
    return f"{processes}{device} ({name}){threads}, mixed precision {launched.mixed_precision}"


# Random choices as pure functions of seed and step, so that resuming needs no stored state.
#
# Every choice has its own generator, made from the seed and words that name the choice, the step
# and the process. So a resumed training makes the same choices, and reordering two choices in the
# code does not change them.


def generator(seed: int, *words: str | int) -> np.random.Generator:
    """Return the generator of a choice, identified by names, and numbers such as step and rank."""
    return np.random.default_rng(np.random.SeedSequence(_entropy(seed, words)))


def seed_torch(seed: int, *words: str | int) -> None:
    """Seed the draws of networks, such as dropout; call it at the start of a step."""
    torch.manual_seed(_entropy(seed, words) % 2**63)


def batch(
    seed: int, step: int, size: int, count: int, *, rank: int = 0, ranks: int = 1
) -> NDArray[np.int64]:
    """Return the items of `count` that a process sees in a step (size,), without repeats in a pass.

    Each pass covers all items, in its own order, before the next begins; a batch may span two
    passes. The processes (`rank` of `ranks`) of one step see different parts of the same order.
    """
    if count < 1 or size < 1:
        raise LearningError(f"batch: found {size} of {count}; allowed: 1 and more of 1 and more")
    first = (step * ranks + rank) * size
    positions = np.arange(first, first + size)
    passes, within = np.divmod(positions, count)
    chosen = np.empty(size, np.int64)
    for number in np.unique(passes).tolist():
        here = passes == number
        chosen[here] = _order(seed, number, count)[within[here]]
    return chosen


@functools.lru_cache(maxsize=8)
def _order(seed: int, number: int, count: int) -> NDArray[np.int64]:
    order = generator(seed, "order", "", number).permutation(count).astype(np.int64)
    order.setflags(write=False)
    return order


def _entropy(seed: int, values: tuple[str | int, ...]) -> int:
    """Return 128 bits that depend on every value and on their order."""
    # Type and length are hashed with each value, so that ("a", 1) differs from ("a1",).
    text = "".join(
        f"{type(value).__name__} {len(str(value))} {value} " for value in (seed, *values)
    )
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little")


# Ctrl-C during a training: the first ends it after the current step, a second ends it at once.
#
# SIGTERM, which cluster schedulers send before they reclaim a machine, has the same effect.

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# A signal within this time [s] of the first is a duplicate: torchrun forwards signals that all get.
_ECHO = 1.0


class Stop:
    """A context manager that handles stop signals; active in the main thread only."""

    def __init__(
        self,
        say: Callable[[str], None] = lambda line: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Set `say`, which is called once when a stop is requested."""
        self._say, self._clock = say, clock
        self._before: dict[signal.Signals, Any] = {}
        self._since = 0.0
        self.requested = False
        """True if no further step should begin."""

    def agreed(self, launched: Accelerator) -> bool:
        """Return True if any process was asked to stop: all must end after the same step."""
        if launched.num_processes == 1:
            return self.requested
        requested = torch.tensor(float(self.requested), device=launched.device)
        total: Any = launched.reduce(requested, reduction="sum")
        return bool(total > 0)

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = {each: signal.signal(each, self._take) for each in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)
        self._before = {}

    def _take(self, number: int, frame: FrameType | None) -> None:
        now = self._clock()
        if not self.requested:
            self.requested, self._since = True, now
            self._say("stopping: finishing and saving the current step; again stops at once")
        elif now - self._since > _ECHO:
            raise KeyboardInterrupt


@dataclass(frozen=True, slots=True, eq=False)
class TrainingSession:
    """Surroundings of a training: where it computes and writes, who stops and watches it."""

    accelerator: Accelerator
    """Device and precision, as set up by Accelerate."""
    run: RunFolder = field(default_factory=RunFolder.nowhere)
    """Folder from which it resumes, for log, checkpoints and model."""
    stop: Stop = field(default_factory=Stop)
    """Ctrl-C handler; enter it only where the current step can be completed first."""
    progress: ReportItems = lambda done, total: None
    """Called with the number of steps done and the total."""
    reading: ReportItems = lambda done, total: None
    """Called likewise as data is read."""

    @property
    def device(self) -> torch.device:
        """Device of the computation."""
        device: torch.device = self.accelerator.device
        return device

    def stopping(self) -> bool:
        """Return True if any process was asked to stop: all end after the same step."""
        return self.stop.agreed(self.accelerator)

    def passed(self, done: int, total: int) -> bool:
        """Report a step; return True if no other may begin, as a stop was requested."""
        self.progress(done, total)
        return self.stopping()


@contextlib.contextmanager
def session_of(run: RunFolder, launch: LaunchSettings, name: str) -> Iterator[TrainingSession]:
    """Yield the surroundings of a training in this process, which show its steps as `name`.

    A stop that was requested meanwhile is raised as Ctrl-C once the block is left.
    """
    with (
        ItemProgress(name, sys.stderr) as steps,
        Stop(functools.partial(print, file=sys.stderr)) as stop,
    ):
        yield TrainingSession(accelerator(launch), run, stop, steps)
    if stop.requested and not run.finished:
        raise KeyboardInterrupt
