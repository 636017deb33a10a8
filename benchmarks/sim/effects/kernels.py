"""Kernels that a run launches, and the compile time of each."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp


@contextmanager
def launches(compiled: dict[str, float]) -> Iterator[set[str]]:
    """Collect the names of the kernels that are launched inside the context.

    A kernel that is not in `compiled` is compiled first, if it is not in Warp's cache, and its
    CPU seconds are stored there.
    """
    launch, found = wp.launch, set[str]()

    def noted(kernel: Any, *args: Any, **options: Any) -> Any:
        name = kernel.module.name
        found.add(name)
        if name not in compiled:
            began = time.process_time()
            kernel.module.load(options["device"])
            compiled[name] = time.process_time() - began
        return launch(kernel, *args, **options)

    wp.launch = noted
    try:
        yield found
    finally:
        wp.launch = launch
