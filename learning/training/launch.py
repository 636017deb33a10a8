"""The devices that a training runs on: one process as it is, or as many as `torchrun` starts.

python -m learning train-force ...                              # one GPU, or the CPU
torchrun --nproc-per-node 4 -m learning train-force ...         # four GPUs of one host
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch

from learning.errors import LearningError

if TYPE_CHECKING:
    from accelerate import Accelerator

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
