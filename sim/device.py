"""Start of Warp without its banner, and the check of the requested device."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from sim.errors import SceneError, check_kind


def ready_device(name: str) -> Path | None:
    """Start Warp, silent below warnings; return the folder in which it caches compiled kernels."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    with _without_driver_warning(gpu_requested=name != "cpu"):
        wp.init()  # type: ignore[no-untyped-call]
    devices = [device.alias for device in wp.get_devices()]
    if name not in devices:
        raise SceneError(f"--device: {name!r}; allowed here: {', '.join(devices)}")
    _check_compiler(name)
    return Path(wp.config.kernel_cache_dir) if wp.config.kernel_cache_dir else None


def check_device(name: str) -> None:
    """Reject a device that this machine does not have; silence Warp's messages below warnings.

    A program that sets `wp.config.log_level` to another level than the default keeps it. A device
    on the null stream, where no graph can be recorded, gets a stream: Warp reads arrays on the null
    stream, and an interrupt at that moment leaves the device there.
    """
    import warp as wp

    check_kind("device", name, str, "cpu, or cuda:0 and the like")
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    try:
        device = wp.get_device(name)
    except (ValueError, RuntimeError) as error:
        allowed = ", ".join(str(each) for each in wp.get_devices())
        raise SceneError(f"device: {name!r}; allowed here: {allowed}") from error
    _check_compiler(name)
    if device.is_cuda and not device.stream.cuda_stream:
        device.set_stream(wp.Stream(device))


def _check_compiler(name: str) -> None:
    """Reject a CPU for which Warp has no compiler: a part of its package, which may be missing."""
    import warp as wp

    if name == "cpu" and not wp.is_cpu_available():
        raise SceneError(
            "device: 'cpu', for which Warp has no compiler here (warp-clang); allowed: with the "
            "whole package, pip install --force-reinstall warp-lang"
        )


@contextlib.contextmanager
def _without_driver_warning(*, gpu_requested: bool) -> Iterator[None]:
    """Drop the warning of Warp's native part about a missing GPU driver, unless a GPU is requested.

    It is written to the process's standard error, past `sys.stderr`; all else is passed on.
    """
    if gpu_requested:
        yield
        return
    sys.stderr.flush()
    stderr = os.dup(2)
    try:
        with tempfile.TemporaryFile() as message:
            os.dup2(message.fileno(), 2)
            try:
                yield
            finally:
                os.dup2(stderr, 2)
            message.seek(0)
            for line in message.read().splitlines(keepends=True):
                if b"CUDA warning" not in line:
                    os.write(2, line)
    finally:
        os.close(stderr)
