"""What a training stands on: its folder, the devices, chance without state, Ctrl-C.

The folder says how far it is, what it measured, and holds its model in the end:

    config.yaml                     kind, settings, data, code version
    metrics.jsonl, tensorboard/     what `log` was told
    checkpoints/00001000/           model.safetensors, training.pt, config.yaml
    model.safetensors               once it is finished: the folder is a model then

A checkpoint is written under a temporary name and renamed, so that there are only whole ones. The
last few are kept, and the best. A run goes on after its newest checkpoint; what was logged later is
taken off the log again.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import os
import pickle
import shutil
import signal
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from learning.config import differing_keys, settings_to_dict
from learning.errors import LearningError
from learning.training.checkpoint import (
    CONFIG,
    KINDS,
    MODEL,
    Config,
    code_version,
    load_weights,
    read_config,
    save_weights,
)
from recorder.store import replace_file, sync_directory

if TYPE_CHECKING:
    from accelerate import Accelerator
    from torch.utils.tensorboard import SummaryWriter


METRICS, CHECKPOINTS, TRAINING = "metrics.jsonl", "checkpoints", "training.pt"

_TENSORBOARD = "tensorboard"
_WRITING, _REPLACED = ".writing-", ".replaced-"
_RNG = "torch_rng"


class RunFolder:
    """One training's folder; `open` makes it. A context manager that closes the logs."""

    def __init__(self, path: Path, config: Config, *, keep: int = 2, writes: bool = True) -> None:
        """Show a folder that `open` has prepared."""
        self.path, self.config, self.keep, self.writes = path, config, keep, writes
        self._board: SummaryWriter | None = None

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        kind: str,
        settings: Any,
        data_fingerprint: str,
        resume: bool = False,
        *,
        facts: Mapping[str, Any] | None = None,
        keep: int = 2,
        writes: bool = True,
    ) -> Self:
        """Begin a run, or go on with it.

        Args:
            path: Its folder.
            kind: One of `KINDS`.
            settings: Frozen dataclass that says all about the training.
            data_fingerprint: Of what is trained on, split included.
            resume: Whether a run that is there goes on; where there is none it begins.
            facts: What is known before training and needed to use the model; plain values.
            keep: Checkpoints that are kept beside the best.
            writes: Whether this process writes; with several, the main one alone.

        Raises:
            LearningError: A run is there and `resume` is not asked for, it was begun with other
                settings or data, or something else lies there.
        """
        folder = Path(path)
        if kind not in KINDS:
            raise LearningError(f"kind: found {kind!r}; allowed: {', '.join(KINDS)}")
        if keep < 1:
            raise LearningError(f"keep: found {keep}; allowed: 1 and more")
        config = Config(
            kind, settings_to_dict(settings), data_fingerprint, code_version(), dict(facts or {})
        )
        run = cls(folder, config, keep=keep, writes=writes)
        if not writes:
            return run
        if (folder / CONFIG).exists():
            _require_same(folder, config, resume)
            run._forget_later()
        elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise LearningError(f"{folder}: holds something else; allowed: a new or empty folder")
        else:
            folder.mkdir(parents=True, exist_ok=True)
            config.write(folder)
        return run

    @property
    def finished(self) -> bool:
        """Whether the model is there."""
        return (self.path / f"{MODEL}.safetensors").is_file()

    def log(self, step: int, values: Mapping[str, float | str]) -> None:
        """Add what was measured after a step to the log and to TensorBoard.

        Args:
            step: Number of steps done.
            values: Numbers by name (`train/loss`); what is not finite is stored as null.
        """
        if not self.writes:
            return
        plain = {name: _plain(value) for name, value in values.items()}
        with (self.path / METRICS).open("a", encoding="utf-8") as file:
            file.write(json.dumps({"step": step, **plain}) + "\n")
        if self._board is None:
            # Seconds to import: not for whoever only reads a folder.
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(self.path / _TENSORBOARD), purge_step=step)
        for name, value in plain.items():
            if isinstance(value, int | float):
                self._board.add_scalar(name, value, step)

    def save(
        self,
        step: int,
        models: Mapping[str, nn.Module | Mapping[str, Tensor]],
        training: Mapping[str, Any],
        *,
        score: float | None = None,
    ) -> Path:
        """Write a checkpoint, then drop those that are not to be kept.

        Args:
            step: Number of steps done.
            models: Networks by name, not wrapped by Accelerate; `model` is the one to be used.
            training: What else is needed to go on, by name: optimisers and whatever else has a
                `state_dict`, or plain values. Torch's generators are kept as well.
            score: What the model is judged by, less being better; None: it was not.

        Raises:
            LearningError: Something among `training` that cannot be read back safely.
        """
        folder = self.path / CHECKPOINTS / f"{step:08d}"
        if not self.writes:
            return folder
        building = folder.with_name(_WRITING + folder.name)
        shutil.rmtree(building, ignore_errors=True)
        building.mkdir(parents=True)
        for name, model in models.items():
            save_weights(model, building / f"{name}.safetensors")
        states = {name: _state(value) for name, value in training.items()}
        torch.save({**states, _RNG: _rng_state()}, building / TRAINING)
        _read_training(building / TRAINING)
        replace(self.config, step=step, score=score).write(building)
        for file in building.iterdir():
            _sync(file)
        sync_directory(building)
        if folder.exists():
            folder.rename(folder.with_name(_REPLACED + folder.name))
        building.rename(folder)
        sync_directory(folder.parent)
        self._prune()
        return folder

    def latest(self) -> Path | None:
        """Return the newest checkpoint, or None."""
        found = self._checkpoints()
        return found[-1] if found else None

    def best(self) -> Path | None:
        """Return the checkpoint with the least score, the older of equal ones; None without."""
        scored = [(read_config(path).score, path) for path in self._checkpoints()]
        known = [(score, path) for score, path in scored if score is not None]
        return min(known)[1] if known else None

    def restore(
        self,
        models: Mapping[str, nn.Module],
        training: Mapping[str, Any] | None = None,
        *,
        checkpoint: Path | None = None,
    ) -> int:
        """Load a checkpoint into networks and optimisers; return the number of steps done.

        Args:
            models: Networks by the names that they were saved under, not wrapped by Accelerate.
            training: What has a `load_state_dict`, by name; what has none is left as it is.
            checkpoint: Which one; None: the newest. Where there is none, nothing changes: 0 steps.

        Raises:
            LearningError: Weights or states that are missing or of another network.
        """
        folder = checkpoint or self.latest()
        if folder is None:
            return 0
        for name, model in models.items():
            load_weights(model, folder / f"{name}.safetensors")
        states = _read_training(folder / TRAINING)
        for name, value in (training or {}).items():
            if not hasattr(value, "load_state_dict"):
                continue
            if name not in states:
                raise LearningError(f"{folder / TRAINING}: found no {name!r}")
            try:
                value.load_state_dict(states[name])
            except (ValueError, KeyError, RuntimeError) as error:
                raise LearningError(f"{folder / TRAINING}.{name}: does not fit: {error}") from error
        _set_rng_state(states[_RNG])
        step = read_config(folder).step
        if step is None:
            raise LearningError(f"{folder / CONFIG}.step: missing; allowed: a number of steps")
        return step

    def training_values(self, checkpoint: Path | None = None) -> dict[str, Any]:
        """Return what a checkpoint keeps beside networks, by name; empty where there is none.

        Raises:
            LearningError: It is damaged.
        """
        folder = checkpoint or self.latest()
        return {} if folder is None else _read_training(folder / TRAINING)

    def finish(
        self,
        step: int,
        models: Mapping[str, nn.Module | Mapping[str, Tensor]],
        *,
        facts: Mapping[str, Any] | None = None,
        score: float | None = None,
    ) -> None:
        """Write the model: the folder is one that can be used from now on.

        Args:
            step: Number of steps done.
            models: Networks by name; `model` is the one to be used.
            facts: What else was found and belongs to the model; plain values.
            score: What the model is judged by.
        """
        if not self.writes:
            return
        facts = {**self.config.facts, **(facts or {})}
        self.config = replace(self.config, step=step, score=score, facts=facts)
        self.config.write(self.path)
        # The one that makes the run finished comes last.
        for name in sorted(models, key=lambda name: name == MODEL):
            save_weights(models[name], self.path / f"{name}.safetensors")

    def close(self) -> None:
        """End the logs. Safe twice."""
        if self._board is not None:
            self._board.close()
            self._board = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _checkpoints(self) -> list[Path]:
        """Return whole checkpoints, oldest first."""
        folder = self.path / CHECKPOINTS
        found = [path for path in folder.glob("*") if path.name.isdecimal()]
        return sorted(path for path in found if (path / CONFIG).is_file())

    def _prune(self) -> None:
        kept = {*self._checkpoints()[-self.keep :], self.best()}
        for path in self._checkpoints():
            if path not in kept:
                shutil.rmtree(path)
        for name in (_WRITING, _REPLACED):
            for left in (self.path / CHECKPOINTS).glob(f"{name}*"):
                shutil.rmtree(left)

    def _forget_later(self) -> None:
        """Take off the log what was measured after the newest checkpoint, or cut short."""
        log = self.path / METRICS
        if self.finished or not log.exists():
            return
        newest = self.latest()
        last = 0 if newest is None else int(newest.name)
        kept = [line for line in log.read_text(encoding="utf-8").splitlines() if _upto(line, last)]
        replace_file(log, "".join(f"{line}\n" for line in kept).encode())


def _require_same(folder: Path, config: Config, resume: bool) -> None:
    there = read_config(folder)
    if not resume:
        raise LearningError(f"{folder}: a run is there; resume it, or choose another folder")
    different = differing_keys(
        {"kind": there.kind, "settings": there.settings, "data": there.data},
        {"kind": config.kind, "settings": config.settings, "data": config.data},
    )
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


def _state(value: Any) -> Any:
    return value.state_dict() if hasattr(value, "state_dict") else value


def _read_training(path: Path) -> dict[str, Any]:
    try:
        states: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise LearningError(f"{path}: no such file") from None
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
        raise LearningError(f"{path}: damaged, or not plain states: {error}") from error
    return states


def _rng_state() -> dict[str, Tensor]:
    state = {"cpu": torch.get_rng_state()}
    if torch.cuda.is_available():
        state["cuda"] = torch.cuda.get_rng_state()
    return state


def _set_rng_state(state: Mapping[str, Tensor]) -> None:
    torch.set_rng_state(state["cpu"])
    if "cuda" in state and torch.cuda.is_available():
        torch.cuda.set_rng_state(state["cuda"])


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# The devices that a training runs on: one process as it is, or as many as `torchrun` starts.
#
# python -m learning train-force ...                              # one GPU, or the CPU
# torchrun --nproc-per-node 4 -m learning train-force ...         # four GPUs of one host

Precision = Literal["no", "bf16", "fp16"]


@dataclass(frozen=True, slots=True)
class LaunchSettings:
    """Where a training runs, and in what precision."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    """`auto` is a GPU where there is one."""
    mixed_precision: Precision = "no"
    """Numbers that networks are evaluated in; weights stay float32."""
    deterministic: bool = False
    """Whether kernels that sum in no fixed order are avoided where there are others."""


def accelerator(settings: LaunchSettings) -> Accelerator:
    """Return what wraps models and optimisers, on the device that was asked for.

    Raises:
        LearningError: No such device, or one that cannot compute in that precision.
    """
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
    if settings.deterministic:
        torch.use_deterministic_algorithms(True, warn_only=True)
    if PartialState._shared_state and PartialState().num_processes == 1:
        # Accelerate keeps what a process first asked for; another training may want otherwise.
        AcceleratorState._reset_state(reset_partial_state=True)
    return Accelerator(cpu=on_cpu, mixed_precision=settings.mixed_precision)


def described(launched: Accelerator) -> str:
    """Return in a line what a training runs on."""
    device = launched.device
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU"
    threads = "" if device.type == "cuda" else f", {torch.get_num_threads()} threads"
    count = launched.num_processes
    processes = f"{count} processes, " if count > 1 else ""
    return f"{processes}{device} ({name}){threads}, mixed precision {launched.mixed_precision}"


# Chance as a pure function of seed and step: what resumes needs to remember nothing.
#
# Every choice has a generator of its own, made from the seed and words that say what is chosen, on
# which step, by which process. So a training that was stopped goes on with the same choices, and
# two choices that were put in another order stay what they were.


def generator(seed: int, *words: str | int) -> np.random.Generator:
    """Return the generator of a choice.

    Args:
        seed: Of the whole training.
        words: What is chosen: names, and numbers such as step and rank.
    """
    return np.random.default_rng(np.random.SeedSequence(_entropy(seed, words)))


def seed_torch(seed: int, *words: str | int) -> None:
    """Seed what networks draw themselves, dropout for instance; call it at the start of a step."""
    torch.manual_seed(_entropy(seed, words) % 2**63)


def batch(
    seed: int, step: int, size: int, count: int, *, rank: int = 0, ranks: int = 1, what: str = ""
) -> NDArray[np.int64]:
    """Return which of `count` things a process sees on a step (size,): passes without repeats.

    All are seen once, in an order of its own, before the next pass begins; a batch may reach from
    one pass into the next. The processes of one step see different parts of the same order.

    Args:
        seed: Of the whole training.
        step: From 0.
        size: Of the batch of one process.
        count: How many things there are.
        rank: Number of the process.
        ranks: How many processes there are.
        what: Name of the choice, where there are several.

    Raises:
        LearningError: Nothing to choose from.
    """
    if count < 1 or size < 1:
        raise LearningError(f"batch: found {size} of {count}; allowed: 1 and more of 1 and more")
    first = (step * ranks + rank) * size
    places = np.arange(first, first + size)
    passes, within = np.divmod(places, count)
    chosen = np.empty(size, np.int64)
    for number in np.unique(passes).tolist():
        here = passes == number
        chosen[here] = _order(seed, what, number, count)[within[here]]
    return chosen


@functools.lru_cache(maxsize=8)
def _order(seed: int, what: str, number: int, count: int) -> NDArray[np.int64]:
    """Return the order of one pass."""
    order = generator(seed, "order", what, number).permutation(count).astype(np.int64)
    order.setflags(write=False)
    return order


def _entropy(seed: int, words: tuple[str | int, ...]) -> int:
    """Return 128 bits that depend on every word and on their order."""
    # Words are told apart by their kind and length, so that ("a", 1) is not ("a1",).
    text = "".join(f"{type(word).__name__} {len(str(word))} {word} " for word in (seed, *words))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little")


# Ctrl-C while a model is trained: once ends after the step in hand, twice ends at once.
#
# SIGTERM, which queues of clusters send before they take a machine back, asks as Ctrl-C does.

# Exit code of a training that was asked to stop and did.
EXIT_INTERRUPTED = 130

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# A signal so soon after the first [s] is the same one: torchrun passes on what all have got.
_ECHO = 1.0


class Stop:
    """Takes signals while it is open: a context manager, of the main thread alone."""

    def __init__(
        self,
        say: Callable[[str], None] = lambda line: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Call `say` once when the step in hand is waited for."""
        self._say, self._clock = say, clock
        self._before: dict[signal.Signals, Any] = {}
        self._since = 0.0
        self.asked = False
        """Whether no step should begin any more."""

    def agreed(self, launched: Accelerator) -> bool:
        """Return whether any process was asked: all of them must end after the same step."""
        if launched.num_processes == 1:
            return self.asked
        asked = torch.tensor(float(self.asked), device=launched.device)
        total: Any = launched.reduce(asked, reduction="sum")
        return bool(total > 0)

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = {each: signal.signal(each, self._take) for each in _SIGNALS}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for each, handler in self._before.items():
            signal.signal(each, handler)
        self._before = {}

    def _take(self, number: int, frame: FrameType | None) -> None:
        now = self._clock()
        if not self.asked:
            self.asked, self._since = True, now
            self._say("stopping: the step in hand is finished and saved; again stops at once")
        elif now - self._since > _ECHO:
            raise KeyboardInterrupt
