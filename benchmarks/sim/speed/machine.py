"""Memory and arithmetic rates of a machine, measured next to the runs that are compared."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

# Size of an array larger than any cache.
FAR_BYTES = 256 * 2**20
# Minimum duration of measuring a rate [s].
LEAST_SECONDS = 0.2
# Side of the matrices that are multiplied.
SIDE = 1024
# float32 operations per second outside of tensor cores, by a word in the GPU's name: NVIDIA's data
# sheets of the H200 SXM, H100 SXM and A100.
STATED_FLOPS = {"H200": 66.9e12, "H100": 66.9e12, "A100": 19.5e12}


def machine_name(device: str) -> str:
    """Return a description of the machine."""
    if device != "cpu":
        import warp as wp

        return str(wp.get_device(device).name)
    described = Path("/proc/cpuinfo")
    model = "CPU"
    if described.exists():
        for line in described.read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    return f"{model}, {os.cpu_count()} cores"


def copy_rate(device: str, size: int, threads: int = 1) -> float:
    """Return the bytes read and written per second by copies of `size` bytes.

    NumPy copies on a CPU, in `threads` threads with separate arrays; Warp copies on a GPU.
    """
    if device != "cpu":
        return _copy_rate_gpu(device, size)

    def copies(index: int) -> float:
        source = np.full(size // 4, float(index), np.float32)
        target = np.zeros_like(source)
        return 2 * size / _least_seconds(lambda: np.copyto(target, source))

    with ThreadPoolExecutor(threads) as pool:
        return float(sum(pool.map(copies, range(threads))))


def _copy_rate_gpu(device: str, size: int) -> float:
    import warp as wp

    source = wp.zeros(size // 4, dtype=wp.float32, device=device)
    target = wp.zeros_like(source)

    def copies() -> None:
        for _copy in range(20):
            wp.copy(target, source)
        wp.synchronize_device(device)

    return 2 * size * 20 / _least_seconds(copies)


def flop_rate(device: str) -> tuple[float, str]:
    """Return the peak float32 operations per second, and the source of the number."""
    if device == "cpu":
        left = np.ones((SIDE, SIDE), np.float32)
        product = np.empty_like(left)
        seconds = _least_seconds(lambda: np.matmul(left, left, out=product))
        return 2 * SIDE**3 / seconds, "matrix product of NumPy, all cores"
    name = machine_name(device)
    for word, rate in STATED_FLOPS.items():
        if word in name:
            return rate, "NVIDIA's data sheet"
    return float("nan"), "not stated"


def _least_seconds(work: Callable[[], object]) -> float:
    """Return the minimum wall time of `work`, called repeatedly."""
    least = float("inf")
    work()
    until = time.perf_counter() + LEAST_SECONDS
    while True:
        began = time.perf_counter()
        work()
        ended = time.perf_counter()
        least = min(least, ended - began)
        if ended > until:
            return least
