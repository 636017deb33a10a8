"""Start of Warp without its banner, the check of the requested device, and loading of kernels."""

import contextlib
import functools
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from pathlib import Path
from typing import Any

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


def kind_of(device: str) -> str:
    """Return the key of a device in tables of settings: `cpu`, or `cuda` for a GPU."""
    return "cpu" if device == "cpu" else "cuda"


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


# Most threads that compile kernels. Each translates Warp's headers for itself, once: a third of the
# work for all kernels of a press, which is 10 s of a core. Processes that share the cores have
# `OMP_NUM_THREADS`, which is not exceeded.
COMPILERS = 4
# Modules made inside `loaded_together`, with their threads per block.
_loading = ContextVar[dict[tuple[Any, int], None]]("_loading")


def kernel(*, group: str = "unique", block: int = 256) -> Callable[[Callable[..., None]], Any]:
    """Return a decorator that makes a Warp kernel without derivatives.

    It is compiled in a module of its own, or with all others of a `group`, which are made together.
    On a GPU it is launched with `block` threads per block.
    """
    import warp as wp

    def made(function: Callable[..., None]) -> Any:
        one = wp.kernel(enable_backward=False, module=group)(function)
        _loading.get({})[one.module, block] = None
        return one

    return made


@contextlib.contextmanager
def loaded_together(device: str) -> Iterator[None]:
    """Load the kernels that were made inside at the end of the context, compiled side by side."""
    import warp as wp

    modules: dict[tuple[Any, int], None] = {}
    token = _loading.set(modules)
    try:
        yield
    finally:
        _loading.reset(token)
    load = _compilers().map(lambda one: wp.load_module(one[0], device, block_dim=one[1]), modules)
    list(load)


@functools.cache
def _compilers() -> ThreadPoolExecutor:
    from recorder.processes import cores

    threads = os.environ.get("OMP_NUM_THREADS", "")
    most = max(1, int(threads)) if threads.isdecimal() else COMPILERS
    return ThreadPoolExecutor(min(most, COMPILERS, cores()), "kernels")
