"""Which kernels a run launches, and what it takes to compile each."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp


@contextmanager
def launches(compiled: dict[str, float]) -> Iterator[set[str]]:
    """While it is open, collects the names of the kernels that are launched.

    A kernel that `compiled` does not know is compiled first, if it is not in Warp's cache, and its
    CPU seconds are noted there.
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
